"""One picture that tells a person at a glance what a run did: layers, wanted, seen, error."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.evaluation.probe import Look
from runtime.records import U8

TILE_WIDTH = 640
MARGIN = 12
TITLE = 34
ERROR_GAIN = 8
INK = (40, 40, 40)
PAPER = 246


def contact_sheet(layers: U8, look: Look | None, *, headline: str) -> U8:
    """(h, w, 3) RGB: a row of layers, and for each eye a row of what it should see, sees, and the difference."""
    height, width = layers.shape[1:3]
    tile = (TILE_WIDTH, round(TILE_WIDTH * height / width))
    names = {0: "layer 0 (rear, at the backlight)", len(layers) - 1: f"layer {len(layers) - 1} (front)"}
    rows = [[(names.get(n, f"layer {n}"), np.ascontiguousarray(layers[n, ..., :3])) for n in range(len(layers))]]
    if look is not None:
        for side, eye in enumerate(("left", "right")):
            seen = look.seen[side]
            target = look.wanted[side].astype(np.float32) / 255
            shown = np.where(seen.mask[..., None], seen.image, 0.94)
            error = np.where(seen.mask[..., None], np.abs(seen.image - target) * ERROR_GAIN, 0.94)
            decibels = look.quality.eye_psnr_db[side]
            rows.append(
                [
                    (f"{eye} eye: wanted", look.wanted[side]),
                    (f"{eye} eye: seen through the layers, {decibels:.1f} dB", _bytes(shown)),
                    (f"{eye} eye: error x {ERROR_GAIN} (black is perfect)", _bytes(error)),
                ]
            )
    columns = max(len(row) for row in rows)
    cell = (tile[0] + MARGIN, tile[1] + MARGIN + TITLE)
    sheet = np.full((TITLE + MARGIN + cell[1] * len(rows), MARGIN + cell[0] * columns, 3), PAPER, np.uint8)
    _write(sheet, headline, x=MARGIN, y=TITLE - 8, scale=0.62)
    for r, row in enumerate(rows):
        for c, (title, picture) in enumerate(row):
            x, y = MARGIN + c * cell[0], TITLE + r * cell[1]
            _write(sheet, title, x=x, y=y + TITLE - 8, scale=0.55)
            small = cv2.resize(picture, tile, interpolation=cv2.INTER_AREA)
            sheet[y + TITLE : y + TITLE + tile[1], x : x + tile[0]] = small
    return sheet


def _bytes(picture: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> U8:
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


def _write(sheet: U8, text: str, *, x: int, y: int, scale: float) -> None:
    cv2.putText(sheet, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)
