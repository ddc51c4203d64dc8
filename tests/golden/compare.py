"""Finds differences between a stored and a new run, by field and tolerance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.records import U8

EQUAL = 0.0
CLOSE = 1e-6  # of metres, pixels, milliseconds
DECIBEL = 0.05
SIMILARITY = 0.002  # of SSIM
CODE = 0.05  # of the mean and the spread of a panel's 8-bit codes

# Anything that is not here is equal: states, labels, reasons, counts, times in nanoseconds, numbers of solutions.
TOLERANCES = {
    "eyes_m": CLOSE,
    "solved_for_m": CLOSE,
    "true_eyes_m": CLOSE,
    "eye_sigma_mm": CLOSE,
    "solution_sigma_mm": CLOSE,
    "solution_age_ms": CLOSE,
    "alignment": CLOSE,
    "flatness": CLOSE,
    "skew_ms": CLOSE,
    "stage_ms": CLOSE,
    "layer_mean": CODE,
    "layer_std": CODE,
    "seconds": CLOSE,
    "states": CLOSE,
    "fps": CLOSE,
    "solutions_per_s": CLOSE,
    "interval_ms": CLOSE,
    "photon_ms": CLOSE,
    "light_db": DECIBEL,
    "psnr_db": DECIBEL,
    "carried_db": DECIBEL,
    "carried_db_true_eyes": DECIBEL,
    "psnr_db_true_eyes": DECIBEL,
    "ssim": SIMILARITY,
}
# Limits for pictures. Without AVX2 and IPP the runs differ by 0.02 codes and 0.001 dB.
PICTURE_MEAN = 0.2  # codes, of the absolute difference
PICTURE_FAR = 4  # codes
PICTURE_FAR_SHARE = 0.002  # of values that may be farther off


@dataclass(frozen=True, slots=True)
class Moved:
    """One value that is another than the stored one."""

    where: int | None  # refresh; None: the summary
    field: str  # with the path into it, as eyes_m[0][2]
    stored: Any
    now: Any
    off: float | None  # None: not a number
    tolerance: float

    @property
    def name(self) -> str:
        """The field without the path into it."""
        return self.field.split("[")[0].split(".")[0]


def moved_values(stored: Any, now: Any, *, field: str, tolerance: float, where: int | None) -> Iterator[Moved]:
    """Every value of two JSON values that differs by more than a tolerance."""
    if isinstance(stored, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*stored, *now)):
            yield from moved_values(
                stored.get(key, ABSENT),
                now.get(key, ABSENT),
                field=f"{field}.{key}" if field else str(key),
                tolerance=TOLERANCES.get(str(key), tolerance),
                where=where,
            )
        return
    if isinstance(stored, list) and isinstance(now, list) and len(stored) == len(now):
        for index, (a, b) in enumerate(zip(stored, now, strict=True)):
            yield from moved_values(a, b, field=f"{field}[{index}]", tolerance=tolerance, where=where)
        return
    if _is_number(stored) and _is_number(now):
        off = abs(float(now) - float(stored))
        if not off <= tolerance:  # NaN is off
            yield Moved(where, field, stored, now, off, tolerance)
    elif stored != now:
        yield Moved(where, field, stored, now, None, tolerance)


ABSENT = "(absent)"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def compare_text(stored: list[dict[str, Any]], now: list[dict[str, Any]]) -> list[Moved]:
    """Differences in a summary (first) and in a run's refreshes (the rest)."""
    found = list(moved_values(stored[0], now[0], field="", tolerance=EQUAL, where=None))
    if len(stored) != len(now):
        found.append(Moved(None, "refreshes", len(stored) - 1, len(now) - 1, None, EQUAL))
    for number, (before, after) in enumerate(zip(stored[1:], now[1:], strict=False)):
        found += moved_values(before, after, field="", tolerance=EQUAL, where=number)
    return found


def compare_picture(stored: U8 | None, now: U8, *, number: int, what: str) -> list[Moved]:
    """Return True if a refresh's panels (N, h, w, 3) still show the same picture."""
    if stored is None or stored.shape != now.shape:
        return [Moved(number, what, "none" if stored is None else stored.shape, now.shape, None, EQUAL)]
    off = np.abs(stored.astype(np.float64) - now)
    found = []
    for panel, part in enumerate(off):
        mean, far = float(part.mean()), float((part > PICTURE_FAR).mean())
        if mean > PICTURE_MEAN:
            found.append(Moved(number, f"{what}[{panel}] mean difference, codes", 0, mean, mean, PICTURE_MEAN))
        if far > PICTURE_FAR_SHARE:
            name = f"{what}[{panel}] share off by more than {PICTURE_FAR} codes"
            found.append(Moved(number, name, 0, far, far, PICTURE_FAR_SHARE))
    return found


def as_lines(case: str, moved: list[Moved]) -> list[str]:
    """The differences for a person: a line a field, where it moved first and where most."""
    lines = []
    for name in dict.fromkeys(m.name for m in moved):
        group = [m for m in moved if m.name == name]
        first = group[0]
        line = f"{case}: {_place(first)} {first.field}: stored {_told(first.stored)}, now {_told(first.now)}"
        if first.off is not None:
            line += f" (off by {first.off:.3g}, tolerance {first.tolerance:g})"
        if len(group) > 1:
            most = max(group, key=lambda m: m.off if m.off is not None else 0.0)
            places = len({m.where for m in group})
            line += f"; {len(group)} values in {places} refresh{'es' if places > 1 else ''}"
            if most.off is not None and most is not first:
                line += f", most at {_place(most)} by {most.off:.3g}"
        lines.append(line)
    return lines


def _place(moved: Moved) -> str:
    return "summary" if moved.where is None else f"refresh {moved.where}"


def _told(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)
