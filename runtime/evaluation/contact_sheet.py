"""One picture that tells a person at a glance what a run did: layers, wanted, seen, error."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from runtime.evaluation.displayed import EyeViews
from runtime.optics.carried import intensities
from runtime.optics.quality import Quality
from runtime.optics.retina import as_codes
from runtime.records import U8

TILE_WIDTH = 640
MARGIN = 12
TITLE = 34
ERROR_GAIN = 8
INK = (40, 40, 40)
PAPER = 246


def contact_sheet(layers: U8, eye_views: EyeViews | None, *, headline: str) -> U8:
    """(h, w, 3) RGB: a row of layers, and for each eye a row of what it should see, sees, and the difference.

    Under the headline, displayed quality at the eyes used and, where they are known, at the true ones.
    """
    height, width = layers.shape[1:3]
    tile = (TILE_WIDTH, round(TILE_WIDTH * height / width))
    names = {0: "layer 0 (rear, at the backlight)", len(layers) - 1: f"layer {len(layers) - 1} (front)"}
    rows = [[(names.get(n, f"layer {n}"), np.ascontiguousarray(layers[n, ..., :3])) for n in range(len(layers))]]
    lines = [headline]
    if eye_views is not None:
        lines += list(_figures(eye_views))
        for side, eye in enumerate(("left", "right")):
            seen = eye_views.seen[side]
            target = intensities(eye_views.wanted[side])
            shown = np.where(seen.mask[..., None], seen.image, 0.94)
            error = np.where(seen.mask[..., None], np.abs(seen.image - target) * ERROR_GAIN, 0.94)
            decibels = eye_views.quality.eye_psnr_db[side]
            rows.append(
                [
                    (f"{eye} eye: wanted", as_codes(target)),
                    (f"{eye} eye: seen through the layers, {decibels:.1f} dB", as_codes(shown)),
                    (f"{eye} eye: error x {ERROR_GAIN} (black is perfect)", as_codes(error)),
                ]
            )
    columns = max(len(row) for row in rows)
    cell = (tile[0] + MARGIN, tile[1] + MARGIN + TITLE)
    head = TITLE * len(lines)
    sheet = np.full((head + MARGIN + cell[1] * len(rows), MARGIN + cell[0] * columns, 3), PAPER, np.uint8)
    for n, line in enumerate(lines):
        _write(sheet, line, x=MARGIN, y=TITLE * (n + 1) - 8, scale=0.62)
    for r, row in enumerate(rows):
        for c, (title, picture) in enumerate(row):
            x, y = MARGIN + c * cell[0], head + r * cell[1]
            _write(sheet, title, x=x, y=y + TITLE - 8, scale=0.55)
            small = cv2.resize(picture, tile, interpolation=cv2.INTER_AREA)
            sheet[y + TITLE : y + TITLE + tile[1], x : x + tile[0]] = small
    return sheet


def _figures(eye_views: EyeViews) -> Iterator[str]:
    """A line for the eyes used, and one for the true ones where anything is known of them."""
    for where, exact, carried in (
        ("at the eyes used", eye_views.quality, eye_views.carried),
        ("at the true eyes", eye_views.true, eye_views.carried_true),
    ):
        parts = [f"exact {_told(exact)} (against what these eyes should see now)"] if exact else []
        parts += [f"carried {_told(carried)} (against the picture that the layers were solved for)"] if carried else []
        if parts:
            yield f"this frame, {where}: " + ", ".join(parts)


def _told(quality: Quality) -> str:
    return f"{quality.psnr_db:.1f} dB"


def _write(sheet: U8, text: str, *, x: int, y: int, scale: float) -> None:
    cv2.putText(sheet, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)
