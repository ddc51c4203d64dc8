"""`calibrate panels`: photographs in, the panels' places in the configuration out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from tomlkit import TOMLDocument

from calib.bundle import Undetermined
from calib.config_file import put, put_homographies, rewrite
from calib.detect_marks import find_marks
from calib.registration import Registration, register_photographs
from calib.viewpoints import viewing_place_m
from runtime.config import Settings
from runtime.errors import InputError
from runtime.optics.stack import UNEVEN_MOST
from runtime.records import U8
from runtime.support.artifacts import write_json
from runtime.support.progress import status_line


def register_photos(
    pictures: Iterable[tuple[str, U8]], source: str, out: Path, settings: Settings, *, config: Path | None
) -> dict[str, Any]:
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
    try:
        found = register_photographs(seen, stack, eye_m=eye_m)
    except Undetermined as problem:
        raise InputError(source, "photographs", str(problem)) from None
    summary = registration_summary(found) | {"source": source}
    write_json(out / "registration.json", summary)
    if config is not None:
        kept = rewrite(config, lambda configured: put_registration(configured, found))
        summary["kept_version"] = str(kept) if kept else None
    return summary


def put_registration(document: TOMLDocument, found: Registration) -> None:
    """Set distances, tilts and homographies in a configuration."""
    put_homographies(document, found.homographies)
    tilt = found.stack.tilt
    table: dict[str, Any] = {"x_m": [round(float(x), 7) for x in found.stack.x_m]}
    if tilt is not None:
        table["tilt"] = [[round(right, 7), round(up, 7)] for _, right, up in tilt.depth]
        table["registered_from_m"] = [round(value, 7) for value in tilt.seen_from_m]
    put(document, "stack", table)


def registration_summary(found: Registration) -> dict[str, Any]:
    """What `registration.json` holds."""
    stack, bundle = found.stack, found.bundle
    rows = np.array([panel.rotation[:, 1] for panel in bundle.panels])
    tilt_deg = np.degrees(np.arctan([panel.slope for panel in bundle.panels]))
    panels = [
        {
            "x_m": stack.x_m[index],
            "tilt_deg": tilt_deg[index],  # by how much its right edge, and its top edge, come towards the viewer
            "turn_deg": np.degrees(np.arctan2(rows[index, 2], rows[index, 1])),  # counter-clockwise, in its own plane
            "homography": found.homographies[index],
            "corner_off_px": np.linalg.norm(found.corners_px[index], axis=1).max(),
            "sigma_px": found.sigma_panel_px[index],
        }
        for index in range(stack.count)
    ]
    notes = list(found.notes)
    if not stack.is_evenly_spaced:
        notes.append(f"the gaps differ by more than {100 * UNEVEN_MOST:.0f}%: the model sart serves them, no network")
    return {
        "reference": bundle.reference,
        "eye_m": found.eye_m,
        "gap_m": np.diff(stack.x_m),
        "gap_sigma_m": found.gap_sigma_m,
        "points": int(bundle.used.sum()),
        "outliers": int((~bundle.used).sum()),
        "used": found.used,
        "eye_error_mm": found.eye_error_mm(),
        "panels": panels,
        "notes": notes,
    }
