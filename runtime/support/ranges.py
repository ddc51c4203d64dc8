"""Ranges of numbers in settings, options and files. Imports nothing heavy."""

from __future__ import annotations

import math

EYE_MOST_M = 50.0  # a coordinate of an eye, either way
SEPARATION_MIN_M = 0.005  # between two eyes: what is unusual for a person is the tracker's business
FOV_RANGE_DEG = (0.1, 179.0)  # least and most of a picture's horizontal field of view
RECORD_MOST_S = 604_800.0  # a week
SCALE = (1e-6, 1e6)  # least and most of a frame's unit by another's: micrometres in metres, and the other way
# What a value may have been given in, by its own unit: factor and name.
OTHER_UNITS = {
    "m": ((1e-3, "millimetres"), (1e-2, "centimetres")),
    "s": ((1e-3, "milliseconds"),),
    "ms": ((1e-3, "microseconds"),),
}


def refusal(value: float, low: float, high: float, unit: str = "") -> str:
    """Why a number does not lie from low to high, both finite; empty where it does.

    >>> refusal(518.4, 0.005, 20.0, "m")
    '518.4 m is beyond 20 m: did you mean millimetres (0.5184)?'
    """
    if low <= value <= high:
        return ""
    named = f" {unit}" if unit else ""
    if math.isnan(value):
        return f"is not a number; it may be {low:g} to {high:g}{named}"
    bound, side = (high, "beyond") if value > high else (low, "below")
    for factor, other in OTHER_UNITS.get(unit, ()):
        if abs(value) > abs(bound) and low <= value * factor <= high:
            return f"{value:g}{named} is {side} {bound:g}{named}: did you mean {other} ({value * factor:g})?"
    return f"{value:g}{named} is {side} {bound:g}{named}; it may be {low:g} to {high:g}{named}"
