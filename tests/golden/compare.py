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


ABSENT = "(absent)"


@dataclass(frozen=True, slots=True)
class Moved:
    """One value that is another than the stored one."""

    where: int | None  # refresh; None: the summary
    field: str  # with the path into it, as eyes_m[0][2]
    stored: Any
    now: Any

    @property
    def name(self) -> str:
        """The field without the path into it."""
        return self.field.split("[")[0].split(".")[0]


def moved_values(
    stored: Any, now: Any, where: int | None, field: str = "", tolerance: float = EQUAL
) -> Iterator[Moved]:
    """Every value of two JSON values that differs by more than a tolerance."""
    if isinstance(stored, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*stored, *now)):
            pair = stored.get(key, ABSENT), now.get(key, ABSENT)
            within = f"{field}.{key}" if field else str(key)
            yield from moved_values(*pair, where, within, TOLERANCES.get(str(key), tolerance))
    elif isinstance(stored, list) and isinstance(now, list) and len(stored) == len(now):
        for index, pair in enumerate(zip(stored, now, strict=True)):
            yield from moved_values(*pair, where, f"{field}[{index}]", tolerance)
    elif _is_number(stored) and _is_number(now):
        if not abs(float(now) - float(stored)) <= tolerance:  # NaN is off
            yield Moved(where, field, stored, now)
    elif stored != now:
        yield Moved(where, field, stored, now)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def compare_text(stored: list[dict[str, Any]], now: list[dict[str, Any]]) -> list[Moved]:
    """Differences in a summary (first) and in a run's refreshes (the rest)."""
    found = [] if len(stored) == len(now) else [Moved(None, "refreshes", len(stored) - 1, len(now) - 1)]
    for number, (before, after) in enumerate(zip(stored, now, strict=False)):
        found += moved_values(before, after, number - 1 if number else None)
    return found


def compare_picture(stored: U8 | None, now: U8, *, number: int, what: str) -> list[Moved]:
    """Differences between a refresh's panels (N, h, w, 3), as stored and now."""
    if stored is None or stored.shape != now.shape:
        return [Moved(number, what, "none" if stored is None else stored.shape, now.shape)]
    off = np.abs(stored.astype(np.float64) - now)
    found = []
    for panel, part in enumerate(off):
        mean, far = float(part.mean()), float((part > PICTURE_FAR).mean())
        if mean > PICTURE_MEAN:
            found.append(Moved(number, f"{what}[{panel}] mean difference, codes", 0, mean))
        if far > PICTURE_FAR_SHARE:
            found.append(Moved(number, f"{what}[{panel}] share off by more than {PICTURE_FAR} codes", 0, far))
    return found


def as_lines(case: str, moved: list[Moved]) -> list[str]:
    """The differences for a person: a line for each field, where it moved first and how often."""
    lines = []
    for name in dict.fromkeys(m.name for m in moved):
        first, *others = (m for m in moved if m.name == name)
        place = "summary" if first.where is None else f"refresh {first.where}"
        values = f"stored {_told(first.stored)}, now {_told(first.now)}"
        lines.append(f"{case}: {place} {first.field}: {values}" + (f"; {len(others)} more" if others else ""))
    return lines


def _told(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)
