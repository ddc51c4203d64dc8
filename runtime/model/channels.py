"""Pictures without colour are solved in one channel. They are told by every pixel: no colour may be lost."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.records import U8

COARSE_STEP = 16  # a look at every so many pixels tells most coloured pictures for next to nothing
RGBA_FROM = {1: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_RGB2RGBA}


def is_grey(picture: U8) -> bool:
    """True where red, green and blue are equal in every pixel of an (h, w, 4) picture."""
    coarse = picture[::COARSE_STEP, ::COARSE_STEP]
    if (coarse[..., 0] != coarse[..., 1]).any() or (coarse[..., 1] != coarse[..., 2]).any():
        return False
    red, green, blue, _ = cv2.split(picture)
    return cv2.norm(red, green, cv2.NORM_INF) == 0.0 and cv2.norm(green, blue, cv2.NORM_INF) == 0.0


def without_alpha(picture: U8, channels: int) -> U8:
    """The (h, w, 4) picture as (h, w, 3), or as (h, w) where it is grey and one channel will do."""
    if channels == 1:
        return np.asarray(cv2.extractChannel(picture, 0), np.uint8)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB), np.uint8)
