"""`calibrate panels`: photographs in, the panels' places in the configuration out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit import TOMLDocument

from calib.board import board
from calib.bundle import Undetermined
from calib.config_file import put, put_homographies, read_document, save_document
from calib.detect_marks import find_marks
from calib.registration import Registration, register_photographs
from calib.viewpoints import viewing_place_m
from runtime.config import Settings
from runtime.errors import InputError
from runtime.optics.stack import UNEVEN_MOST, PanelStack
from runtime.records import U8
from runtime.report.page import in_columns
from runtime.support.artifacts import OutputFolder, write_json, write_png, write_text
from runtime.support.progress import status_line

NOTED_TILT_DEG = 0.3
EVEN_MODELS = ("fast", "balanced", "best")  # networks for evenly spaced panels


def write_boards(out: Path, stack: PanelStack) -> dict[str, Any]:
    """PNGs `board-N.png`, one for each panel, for a computer that phasestack does not run on."""
    files = [f"board-{index}.png" for index in range(stack.count)]
    with OutputFolder(out) as folder:
        for index, name in enumerate(files):
            write_png(folder.staging / name, board(stack, index))
    return {"out": str(out), "files": files}


def register_photos(
    pictures: Iterable[tuple[str, U8]], source: str, out: Path, settings: Settings, *, config: Path | None
) -> tuple[dict[str, Any], str]:
    """Register from named photographs (h, w) of the boards, report, and write into `config` where one is given.

    Raises InputError; nothing is written then.
    """
    stack = settings.stack.stack()
    if config is not None and len(settings.output.panels) not in (0, stack.count):
        problem = f"has {len(settings.output.panels)} tables for {stack.count} panels"
        raise InputError(config, "output.panels", problem)
    seen = []
    with status_line("photographs") as say:
        for name, picture in pictures:
            say(name)
            seen.append(find_marks(picture, stack, name=name))
    eye_m = viewing_place_m(settings.calibration)
    # Even distances where the true ones are too uneven for the configured network.
    even = None if settings.model.name in EVEN_MODELS and stack.count == 3 else False
    try:
        found = register_photographs(seen, stack, eye_m=eye_m, even=even)
    except Undetermined as problem:
        raise InputError(source, "photographs", str(problem)) from None
    summary = registration_summary(found, stack) | {"source": source}
    document = tomlkit.document()
    put_registration(document, found)
    with OutputFolder(out) as folder:
        write_json(folder.staging / "registration.json", summary)
        write_text(folder.staging / "panels.toml", tomlkit.dumps(document))
    if config is not None:
        configured = read_document(config)
        put_registration(configured, found)
        kept = save_document(config, configured)
        summary["kept_version"] = str(kept) if kept else None
    return summary, summary_text(found, summary)


def put_registration(document: TOMLDocument, found: Registration) -> None:
    """Set distances, tilts and homographies in a configuration."""
    put_homographies(document, found.homographies)
    tilt = found.stack.tilt
    table: dict[str, Any] = {"x_m": [round(float(x), 7) for x in found.stack.x_m]}
    if tilt is not None:
        table["tilt"] = [[round(right, 7), round(up, 7)] for _, right, up in tilt.depth]
        table["registered_from_m"] = [round(value, 7) for value in tilt.seen_from_m]
    put(document, "stack", table)


def registration_summary(found: Registration, stack: PanelStack) -> dict[str, Any]:
    """What `registration.json` holds."""
    tilt, turn, sigma = found.tilt_deg, found.turn_deg, found.sigma_panel_px
    panels = []
    for index in range(stack.count):
        mine = (found.bundle.panel == index) & found.bundle.used
        panels.append(
            {
                "panel": index,
                "x_m": found.stack.x_m[index],
                "true_x_m": found.true_x_m[index],
                "tilt_right_deg": tilt[index, 0],
                "tilt_up_deg": tilt[index, 1],
                "turn_deg": turn[index],
                "homography": found.homographies[index],
                "corners_px": found.corners_px[index],
                "corner_sigma_px": found.corner_sigma_px[index],
                "sigma_px": sigma[index],
                "residual_px": panel_residual_px(found, index),
                "points": int(mine.sum()),
            }
        )
    gaps = np.diff(found.true_x_m)
    notes = list(found.notes)
    if not np.allclose(found.true_x_m, found.stack.x_m, atol=5e-5):
        notes.append(
            f"the gaps are {' and '.join(f'{gap * 1e3:.2f}' for gap in gaps)} mm; even ones of "
            f"{(found.stack.x_m[1] - found.stack.x_m[0]) * 1e3:.2f} mm are written, since the shipped networks serve "
            f"none that differ by more than {100 * UNEVEN_MOST:.0f}% (with the model sart the true ones are written)"
        )
    worst = float(np.abs(tilt).max())
    if worst > NOTED_TILT_DEG:
        notes.append(
            f"a panel is tilted by {worst:.1f} degrees against panel {found.bundle.reference}: the shipped models "
            "allow for it; with others it is exact from the viewing place alone"
        )
    return {
        "reference": found.bundle.reference,
        "eye_m": found.eye_m,
        "x_m": list(found.stack.x_m),
        "true_x_m": found.true_x_m,
        "gap_m": gaps,
        "gap_sigma_m": found.gap_sigma_m,
        "sigma_px": found.bundle.sigma_px,
        "points": int(found.bundle.used.sum()),
        "outliers": int((~found.bundle.used).sum()),
        "used": sum(v.used for v in found.verdicts),
        "photographs": [
            {"name": v.name, "used": v.used, "points": v.points, "rms_px": v.rms_px, "reason": v.reason}
            for v in found.verdicts
        ],
        "eye_error_mm": found.eye_error_mm(),
        "lens": dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"), found.bundle.lens, strict=True)),
        "panels": panels,
        "notes": notes,
    }


def panel_residual_px(found: Registration, index: int) -> float:
    """RMS distance of a panel's points from the fit, in pixels of the panel (a photograph's pixel spans some)."""
    bundle = found.bundle
    mine = (bundle.panel == index) & bundle.used
    if not mine.any():
        return 0.0
    distance_m = np.linalg.norm(bundle.places_m - bundle.panels[index].centre_m, axis=1)[bundle.photograph[mine]]
    span = distance_m / bundle.lens[0] / (found.stack.width_m / found.stack.width_px)
    return float(np.sqrt(((bundle.residual_px[mine] * span[:, None]) ** 2).sum(1).mean()))


def panel_rows(found: Registration) -> list[list[str]]:
    """The table for people."""
    rows = [["panel", "x (mm)", "true x (mm)", "turned (°)", "tilt right, up (°)", "corner off (px)", "± (px)",
             "residual (px)"]]  # fmt: skip
    for index in range(len(found.true_x_m)):
        moved = np.linalg.norm(found.corners_px[index], axis=1).max()
        rows.append([
            str(index) + (", the reference" if index == found.bundle.reference else ""),
            f"{found.stack.x_m[index] * 1e3:+.2f}", f"{found.true_x_m[index] * 1e3:+.2f}",
            f"{found.turn_deg[index]:+.3f}", "{:+.2f}, {:+.2f}".format(*found.tilt_deg[index]),
            f"{moved:.2f}", f"{found.sigma_panel_px[index]:.3f}", f"{panel_residual_px(found, index):.3f}",
        ])  # fmt: skip
    return rows


def summary_text(found: Registration, summary: dict[str, Any]) -> str:
    """What the command prints."""
    gaps = ", ".join(
        f"{gap * 1e3:.2f} ± {sigma * 1e3:.2f}"
        for gap, sigma in zip(summary["gap_m"], summary["gap_sigma_m"], strict=True)
    )
    lines = [
        in_columns(panel_rows(found)),
        f"gaps {gaps} mm; {summary['points']} points of {summary['used']} photographs, {summary['outliers']} left out",
        f"what is uncertain is worth {summary['eye_error_mm']:.2f} mm at the eye",
    ]
    return "\n".join([*lines, *(f"note: {note}" for note in summary["notes"])])
