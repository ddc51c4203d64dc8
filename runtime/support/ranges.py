"""Ranges of numbers in settings, options and files. Cheap to import."""

from __future__ import annotations

import math

EYE_MOST_M = 50.0  # largest absolute coordinate of an eye
SEPARATION_MIN_M = 0.005  # minimum distance between two eyes; the tracker checks for a person's
FOV_RANGE_DEG = (0.1, 179.0)  # horizontal field of view of a picture
RECORD_MOST_S = 604_800.0  # a week
SCALE = (1e-6, 1e6)  # range of scales between two frames' units, from micrometres to metres and back
# Units used by mistake, with factor and name, by the proper unit.
OTHER_UNITS = {
    "m": ((1e-3, "millimetres"), (1e-2, "centimetres")),
    "s": ((1e-3, "milliseconds"),),
    "ms": ((1e-3, "microseconds"),),
}


def refusal(value: float, low: float, high: float, unit: str = "") -> str:
    """Return an error message for a number outside [low, high], both finite, or an empty string.

    >>> refusal(518.4, 0.005, 20.0, "m")
    '518.4 m is out of range; for 518.4 millimetres, write 0.5184'
    """
    if low <= value <= high:
        return ""
    named = f" {unit}" if unit else ""
    if math.isnan(value):
        return f"is not a number; use {low:g} to {high:g}{named}"
    bound = high if value > high else low
    for factor, other in OTHER_UNITS.get(unit, ()):
        if abs(value) > abs(bound) and low <= value * factor <= high:
            return f"{value:g}{named} is out of range; for {value:g} {other}, write {value * factor:g}"
    return f"{value:g}{named} is out of range; use {low:g} to {high:g}{named}"
