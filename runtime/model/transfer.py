"""Between 8-bit code values and phases, by tables."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.optics.malus import Branch, phase_from_intensity
from runtime.records import U8

SUBCODE = 16  # fixed point: sixteenths of an 8-bit panel code
FULL = 255 * SUBCODE  # one panel's whole range, a quarter turn
SLOPE_FLOOR = 0.25  # the least weight of a ray beside the slope of sin² where it is wanted


@lru_cache(maxsize=4)
def phase_codes(branch: Branch = 2) -> NDArray[np.int16]:
    """(256,) phase sum, in sixteenths of a panel code, for each 8-bit code value an eye should see."""
    codes = np.arange(256) / 255.0
    return np.rint(phase_from_intensity(codes, branch) * FULL).astype(np.int16)


def pre_emphasised(picture: U8, strength: float) -> U8:
    """Sharpened by what interpolation will blur: on the way to the panels' pixels, and between them in the eye.

    A separable [-a, 1 + 2a, -a] on every channel; 0 leaves the picture as it is.
    """
    if not strength:
        return picture

    kernel = np.array([-strength, 1 + 2 * strength, -strength], np.float32)
    return np.asarray(cv2.sepFilter2D(picture, -1, kernel, kernel), np.uint8)
