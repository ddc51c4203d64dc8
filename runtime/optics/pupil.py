"""How surely a ray's end at the eye is known: a pupil has a width, and a tracker errs."""

from __future__ import annotations

import math
from typing import Literal

PUPIL_DIAMETERS = 4.0  # a disc's standard deviation along an axis is a quarter of its diameter
PUPIL_SIGMA_MM = 1.0  # where nobody tells: the pupil alone, 4 mm wide


def configured_sigma_mm(setting: Literal["auto"] | float, *, pupil_mm: float, tracker_sigma_m: float) -> float:
    """What `model.eye_sigma_mm` comes to: a number as it stands; `auto` the pupil and the tracker together.

    Standard deviation along an axis, millimetres, of where light enters an eye. pupil_mm: the pupil's diameter;
    tracker_sigma_m: metres, an axis, common to both eyes.
    """
    if setting == "auto":
        return math.hypot(pupil_mm / PUPIL_DIAMETERS, tracker_sigma_m * 1e3)
    return float(setting)
