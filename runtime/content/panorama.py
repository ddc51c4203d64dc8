"""Crop 360- or 180-degree equirectangular pictures to the part that is straight ahead."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from runtime.records import F32, U8

AHEAD_DEG = 75.0  # the crop's horizontal field of view, slightly larger than a display's
SHAPE = 16 / 9  # width over height of the crop
ASPECT_OFF = 0.02  # relative tolerance for a view's aspect ratio


def is_around(width: float, height: float, span_deg: int) -> bool:
    """Return True if a view with square pixels has the aspect ratio of `span_deg` by 180 degrees."""
    return abs(width / height * 180 / span_deg - 1) < ASPECT_OFF


def ahead(view: U8, span_deg: int) -> U8:
    """Middle of an equirectangular view (h, w, 3), reprojected to a pinhole camera of similar resolution."""
    u, v = _places(view.shape[1], view.shape[0], span_deg)
    return np.asarray(cv2.remap(view, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


@lru_cache(maxsize=2)
def _places(width: int, height: int, span_deg: int) -> tuple[F32, F32]:
    """Return the view's column and row that each pixel of the crop shows, integers at pixel centres as in OpenCV."""
    columns = max(round(width * AHEAD_DEG / span_deg), 16)
    rows, half = max(round(columns / SHAPE), 9), np.tan(np.radians(AHEAD_DEG / 2))
    x = ((np.arange(columns) + 0.5) * 2 / columns - 1) * half
    y = ((np.arange(rows) + 0.5) * 2 - rows) / columns * half
    x, y = np.meshgrid(x, y)
    around, down = np.arctan(x), np.arctan2(y, np.hypot(x, 1.0))
    u = (around / np.radians(span_deg) + 0.5) * width - 0.5
    v = (down / np.pi + 0.5) * height - 0.5
    return u.astype(np.float32), v.astype(np.float32)
