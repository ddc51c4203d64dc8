"""Where the sensor sees the eyes, over the last half second: what is paired with a viewpoint when it is accepted."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from runtime.clock import NS_PER_S
from runtime.records import F64, EyePoints

WINDOW_NS = NS_PER_S // 2  # a pair is the median over so long
MAX_SPREAD_M = 0.010  # eyes that moved or scattered by more meanwhile make no pair
MIN_SAMPLES = 5
MIN_CONFIDENCE = 0.3
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class Midpoint:
    """The midpoint of the eyes over a window."""

    midpoint_m: F64  # (3,) frame `sensor`
    spread_m: float  # robust RMS distance of the samples from it


def midpoint(eyes: EyePoints | None) -> F64 | None:
    """(3,) middle of two measured eyes; None where one is missing, uncertain or filled in."""
    if eyes is None or eyes.completed or eyes.confidence.min() < MIN_CONFIDENCE:
        return None
    middle = eyes.eyes_m.mean(axis=0)
    return middle if np.isfinite(middle).all() else None


class EyeWindow:
    """The samples of the last half second before the newest one."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, F64]] = deque()  # instant, middle of the eyes

    def add(self, capture_ns: int, eyes: EyePoints | None) -> None:
        """Take in a sample in frame `sensor`; unusable ones only let time pass."""
        middle = midpoint(eyes)
        if middle is not None:
            self._samples.append((capture_ns, middle))
        while self._samples and self._samples[0][0] <= capture_ns - WINDOW_NS:
            self._samples.popleft()

    def clear(self) -> None:
        """Forget all: what was seen before does not belong to what comes."""
        self._samples.clear()

    def measure(self) -> Midpoint | None:
        """Median and spread; None with fewer than `MIN_SAMPLES` samples."""
        if len(self._samples) < MIN_SAMPLES:
            return None
        points = np.array([point for _, point in self._samples])
        centre = np.median(points, axis=0)
        mad_m = np.median(np.abs(points - centre), axis=0) * MAD_TO_SIGMA
        return Midpoint(centre, float(np.linalg.norm(mad_m)))
