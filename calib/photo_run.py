"""`calibrate panels board|photo`: photographs in, the panels' places in the configuration out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer

from calib.bare_panels import BarePanels
from calib.board import board, board_layers
from calib.bundle import Undetermined
from calib.config_file import put, put_homographies, read_document, save_document
from calib.detect_marks import SeenMarks, find_marks
from calib.keys import Key, TerminalKeys, first_of
from calib.panel_run import check_tables, panels_document
from calib.photo_figures import photo_figure
from calib.photo_judge import displayed_db
from calib.photo_live import open_video, take_live
from calib.photo_registration import PhotoRegistration, corner_pixels, homographies, register_photographs
from calib.registration import through
from calib.viewpoints import viewing_place_m
from runtime.config import Settings
from runtime.errors import InputError
from runtime.optics.stack import UNEVEN_MOST, PanelStack
from runtime.records import U8
from runtime.report.page import Figure, Page, in_columns, section_of
from runtime.report.progress import tracked
from runtime.support import foreign
from runtime.support.artifacts import OutputFolder, write_png
from runtime.support.picture_header import is_cut_off, picture_size

PHOTOGRAPH_BYTES_MAX = 512 << 20
PHOTOGRAPH_PIXELS_MAX = 250_000_000  # phones have up to 200 million

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}
MOST_PHOTOGRAPHS = 100
EVEN_MODELS = ("fast", "balanced", "best")  # networks for evenly spaced panels


def write_board(out: Path, stack: PanelStack) -> dict[str, Any]:
    """PNGs `board-N.png`, one for each panel, for a computer that phasestack does not run on."""
    files = [f"board-{index}.png" for index in range(stack.count)]
    with OutputFolder(out) as folder:
        for index, name in enumerate(files):
            write_png(folder.staging / name, board(stack, index))
    return {"out": str(out), "files": files}


def read_photograph(path: Path) -> U8:
    """(h, w) grey, as the sensor saw it: a note to turn it is not heeded. Raises InputError."""
    data = foreign.read_bytes(path, most_bytes=PHOTOGRAPH_BYTES_MAX)
    try:
        width, height = picture_size(data)
    except ValueError:
        width = height = 0
    if width * height > PHOTOGRAPH_PIXELS_MAX:
        raise InputError(path, "", f"has {width} x {height} pixels; at most {PHOTOGRAPH_PIXELS_MAX:,}")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    readable = width > 0 and not is_cut_off(data)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if readable else None
    if picture is None:
        raise InputError(path, "", "is not a photograph that can be decoded (JPEG or PNG; export HEIC as JPEG)")
    return np.asarray(picture)


def photograph_files(folder: Path) -> list[Path]:
    """The photographs of a folder, by name. Raises InputError."""
    if not foreign.is_there(folder, folder=True):
        raise InputError(folder, "", "is not a folder of photographs")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not found:
        raise InputError(folder, "", "holds no photograph (" + ", ".join(sorted(SUFFIXES)) + ")")
    if len(found) > MOST_PHOTOGRAPHS:
        raise InputError(folder, "", f"holds {len(found)} pictures: at most {MOST_PHOTOGRAPHS}")
    return found


def look_at(files: Sequence[Path], stack: PanelStack) -> list[SeenMarks]:
    """The marks of every photograph, with progress. Raises InputError."""
    return [find_marks(read_photograph(path), stack, name=path.name) for path in tracked("photographs", files)]


def register_folder(
    photos: Path,
    out: Path,
    settings: Settings,
    stack: PanelStack,
    *,
    even: bool | None,
    model: str,
    config: Path | None,
) -> tuple[dict[str, Any], str]:
    """Register from a folder of photographs, report, and write into `config` where one is given.

    Raises InputError; nothing is written then.
    """
    seen = look_at(photograph_files(photos), stack)
    return register_seen(seen, str(photos), out, settings, stack, even=even, model=model, config=config)


def register_seen(
    seen: Sequence[SeenMarks],
    source: str,
    out: Path,
    settings: Settings,
    stack: PanelStack,
    *,
    even: bool | None,
    model: str,
    config: Path | None,
) -> tuple[dict[str, Any], str]:
    """The same from photographs whose marks are found."""
    if config is not None:
        check_tables(settings, stack, config)
    eye_m = viewing_place_m(settings.calibration)
    try:
        found = register_photographs(seen, stack, eye_m=eye_m, even=even)
    except Undetermined as problem:
        raise InputError(source, "photographs", str(problem)) from None
    summary = registration_summary(found, stack) | {"source": source}
    if model:
        summary["psnr_db"] = displayed_db(found, settings, stack, model=model)
    figure = Figure("registration", photo_figure(found, stack), "Where the panels and the camera stood")
    page = Page(
        "Registration of the panels by photographs",
        f"{summary['used']} of {len(seen)} photographs, {summary['points']} points; a point is exact to "
        f"{found.bundle.sigma_px:.3f} px of the photograph.",
        [
            replace(section_of("Panels", panel_rows(found)), figures=[figure]),
            section_of("Photographs", photograph_rows(found)),
        ],
        notes=list(summary["notes"]),
    )
    document = panels_document(found.homographies, stack=stack_table(found))
    page.write(out, record="registration.json", data=summary, texts={"panels.toml": document})
    if config is not None:
        kept = write_registration(config, found)
        summary["kept_version"] = str(kept) if kept else None
    return summary, summary_text(found, summary)


def wants_even(settings: Settings, stack: PanelStack) -> bool | None:
    """Whether to write even distances: None: where the true ones are too uneven for the configured model."""
    return None if settings.model.name in EVEN_MODELS and stack.count == 3 else False


def registration_summary(found: PhotoRegistration, stack: PanelStack) -> dict[str, Any]:
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
            f"none that differ by more than {100 * UNEVEN_MOST:.0f}%; from the viewing place nothing is lost, 10 cm "
            f"beside it up to {uneven_cost_px(found):.2f} px (--spacing true writes the true ones, for the model sart)"
        )
    worst = float(np.abs(tilt).max())
    if worst > 0.3:
        notes.append(
            f"a panel is tilted by {worst:.1f} degrees against panel {found.bundle.reference}: the shipped networks "
            "and sart allow for it, and take longer; with other models it is exact from the viewing place, up to "
            f"{tilt_cost_px(found, aside_m=0.1):.1f} px off at its edges 10 cm beside it"
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


def panel_residual_px(found: PhotoRegistration, index: int) -> float:
    """RMS distance of a panel's points from the fit, in pixels of the panel (a photograph's pixel spans some)."""
    bundle = found.bundle
    mine = (bundle.panel == index) & bundle.used
    if not mine.any():
        return 0.0
    distance_m = np.linalg.norm(bundle.places_m - bundle.panels[index].centre_m, axis=1)[bundle.photograph[mine]]
    span = distance_m / bundle.lens[0] / (found.stack.width_m / found.stack.width_px)
    return float(np.sqrt(((bundle.residual_px[mine] * span[:, None]) ** 2).sum(1).mean()))


def uneven_cost_px(found: PhotoRegistration, *, aside_m: float = 0.1) -> float:
    """By how much pixels are off for an eye beside the viewing place, because even distances are written."""
    off_m = float(np.abs(found.true_x_m - np.array(found.stack.x_m)).max())
    return off_m * aside_m / float(found.eye_m[0]) / (found.stack.width_m / found.stack.width_px)


def tilt_cost_px(found: PhotoRegistration, *, aside_m: float) -> float:
    """By how much a corner is off, at most, for an eye that is so far beside the viewing place."""
    corners, worst = corner_pixels(found.stack), 0.0
    for side in (-aside_m, aside_m):
        beside = homographies(found.bundle.panels, found.stack, found.eye_m + np.array([0.0, side, 0.0]))
        for a, b in zip(beside, found.homographies, strict=True):
            moved = through(a, corners) - through(b, corners)
            worst = max(worst, float(np.linalg.norm(moved, axis=1).max()))
    return worst


def panel_rows(found: PhotoRegistration) -> list[list[str]]:
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


def photograph_rows(found: PhotoRegistration) -> list[list[str]]:
    """What became of every photograph."""
    rows = [["photograph", "points", "residual (px)", "verdict"]]
    return rows + [
        [v.name, str(v.points), f"{v.rms_px:.3f}" if v.used else "", "used" if v.used else v.reason]
        for v in found.verdicts
    ]


def summary_text(found: PhotoRegistration, summary: dict[str, Any]) -> str:
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
    if "psnr_db" in summary:
        lines.append(
            "displayed, from the viewing place: "
            + ", ".join(f"{name} {value:.2f} dB" for name, value in summary["psnr_db"].items())
        )
    return "\n".join([*lines, *(f"note: {note}" for note in summary["notes"])])


def stack_table(found: PhotoRegistration) -> dict[str, Any]:
    """What a registration puts into `[stack]`."""
    tilt = found.stack.tilt
    table: dict[str, Any] = {"x_m": [round(float(x), 7) for x in found.stack.x_m]}
    if tilt is not None:
        table["tilt"] = [[round(right, 7), round(up, 7)] for _, right, up in tilt.depth]
        table["registered_from_m"] = [round(value, 7) for value in tilt.seen_from_m]
    return table


def write_registration(config: Path, found: PhotoRegistration) -> Path | None:
    """Put distances, tilts and homographies into a configuration, its comments kept; answers where the old one is kept.

    The new text is checked as a configuration before it takes the old one's place. Raises InputError.
    """
    document = read_document(config)
    put_homographies(document, found.homographies)
    put(document, "stack", stack_table(found))
    return save_document(config, document)


def show_board(settings: Settings, stack: PanelStack) -> None:
    """The boards on the bare panels until a person says that it is enough. Raises InputError, PanelLost."""
    keys = TerminalKeys()
    panels = BarePanels(settings, stack)
    poll = first_of(keys.poll, panels.keys.poll)
    try:
        if not panels.seen:
            typer.echo("warning: output.kind is offscreen: nobody sees these boards", err=True)
        typer.echo("boards are shown (Enter or q: done)", err=True)
        panels.show(board_layers(stack))
        while poll() not in (Key.ACCEPT, Key.QUIT):
            panels.again()
    finally:
        panels.close()
        keys.close()


def register_live(
    device: str,
    out: Path,
    settings: Settings,
    stack: PanelStack,
    *,
    wanted: int,
    even: bool | None,
    model: str,
    config: Path | None,
) -> tuple[dict[str, Any], str]:
    """Show the boards, take photographs from a video device, register. q or Enter: enough. Raises InputError."""
    open_video(device).release()  # refused before anything is shown
    keys = TerminalKeys()
    panels = BarePanels(settings, stack)
    poll = first_of(keys.poll, panels.keys.poll)
    try:
        panels.show(board_layers(stack))

        def stop() -> bool:
            panels.again()
            return poll() in (Key.QUIT, Key.ACCEPT)

        seen = take_live(device, stack, wanted=wanted, say=lambda text: typer.echo(text, err=True), stop=stop)
    finally:
        panels.close()
        keys.close()
    return register_seen(seen, device, out, settings, stack, even=even, model=model, config=config)
