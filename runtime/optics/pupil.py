"""How surely a ray's end at the eye is known: a pupil has a width, and a tracker errs."""

from __future__ import annotations

import math
from typing import Literal

PUPIL_SIGMA_MM = 1.0  # of a pupil alone, 4 mm wide: a disc's standard deviation along an axis is a quarter of that


def configured_sigma_mm(setting: Literal["auto"] | float, *, tracker_sigma_m: float) -> float:
    """What `model.eye_sigma_mm` comes to: a number as it stands; `auto` the pupil and the tracker together.

    Standard deviation along an axis, millimetres, of where light enters an eye. tracker_sigma_m: metres, an axis,
    common to both eyes.
    """
    if setting == "auto":
        return math.hypot(PUPIL_SIGMA_MM, tracker_sigma_m * 1e3)
    return float(setting)
