"""Ranges for numbers in settings, options and files. This module imports no heavy packages."""

from __future__ import annotations

import math

EYE_MOST_M = 50.0  # largest absolute value of an eye's coordinates
SEPARATION_MIN_M = 0.005  # minimum distance between two eyes; the tracker requires one that is plausible for a person
FOV_RANGE_DEG = (0.1, 179.0)  # range of a picture's horizontal field of view
RECORD_MOST_S = 604_800.0  # maximum length of a recording, one week
CENTIMETRES_MOST = 100.0  # numbers below this are more likely centimetres than millimetres
SCALE = (1e-6, 1e6)  # range of scales between two frames' units, wide enough for metres and micrometres
# Units often used by mistake, keyed by the proper unit. Each is given as its factor to the proper unit and its name.
OTHER_UNITS = {
    "m": ((1e-3, "millimetres"), (1e-2, "centimetres")),
    "s": ((1e-3, "milliseconds"),),
    "ms": ((1e-3, "microseconds"),),
}


def refusal(value: float, low: float, high: float, unit: str = "") -> str:
    """Return an error message for a number out of range, or an empty string if the number is in range.
    For m, s and ms, the message suggests a smaller unit if the number would be valid in that unit.

    >>> refusal(518.4, 0.005, 20.0, "m")
    '518.4 m is out of range; for 518.4 millimetres, write 0.5184'
    >>> refusal(51.84, 0.005, 20.0, "m")
    '51.84 m is out of range; for 51.84 centimetres, write 0.5184; for 51.84 millimetres, write 0.05184'
    """
    if low <= value <= high:
        return ""
    named = f" {unit}" if unit else ""
    if math.isnan(value):
        return f"is not a number; use {low:g} to {high:g}{named}"
    bound = high if value > high else low
    units = OTHER_UNITS.get(unit, ()) if abs(value) > abs(bound) else ()
    meant = [(factor, other) for factor, other in units if low <= value * factor <= high]
    if meant:
        shown = meant[::-1] if abs(value) < CENTIMETRES_MOST else meant[:1]
        offers = [f"for {value:g} {other}, write {value * factor:g}" for factor, other in shown]
        return f"{value:g}{named} is out of range; {'; '.join(offers)}"
    return f"{value:g}{named} is out of range; use {low:g} to {high:g}{named}"
