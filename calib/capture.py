"""Where the sensor sees the eyes, over the last half second: what is paired with a viewpoint when it is accepted."""

from __future__ import annotations

import datetime
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.stats import theilslopes

from calib.pairs import PairRow
from runtime.clock import NS_PER_S
from runtime.records import F64, EyePoints

WINDOW_S = 0.5  # a pair is the median over so long
MAX_SPREAD_M = 0.010  # eyes that moved or scattered by more meanwhile make no pair
MIN_SAMPLES = 5
FILLED = 0.9  # of a window's length
MIN_CONFIDENCE = 0.3
OUTLIER_MADS = 5.0
OUTLIER_FLOOR_M = 0.01
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class Midpoint:
    """The midpoint of the eyes over a window."""

    midpoint_m: F64  # (3,) frame `sensor`
    spread_m: float  # robust RMS distance of the samples from it
    samples: int

    def paired(self, stack_m: F64, viewpoint: str, *, serial: str) -> PairRow:
        """With its true place (3,) in `stack`, as a row of the file."""
        sensor, stack = self.midpoint_m.tolist(), stack_m.tolist()
        return PairRow(
            sensor_x=sensor[0], sensor_y=sensor[1], sensor_z=sensor[2],
            stack_x=stack[0], stack_y=stack[1], stack_z=stack[2],
            viewpoint=viewpoint,
            spread_mm=f"{self.spread_m * 1e3:.3f}",
            samples=str(self.samples),
            accepted_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            sensor_serial=serial,
        )  # fmt: skip


def midpoint(eyes: EyePoints | None) -> F64 | None:
    """(3,) middle of two measured eyes; None where one is missing, uncertain or filled in."""
    if eyes is None or eyes.completed or eyes.confidence.min() < MIN_CONFIDENCE:
        return None
    middle = eyes.eyes_m.mean(axis=0)
    return middle if np.isfinite(middle).all() else None


class EyeWindow:
    """The samples of the last `window_s` before the newest one."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._length_ns = round(window_s * NS_PER_S)
        self._samples: deque[tuple[int, F64]] = deque()  # instant, middle of the eyes

    def add(self, capture_ns: int, eyes: EyePoints | None) -> None:
        """Take in a sample in frame `sensor`; unusable ones only let time pass."""
        middle = midpoint(eyes)
        if middle is not None:
            self._samples.append((capture_ns, middle))
        while self._samples and self._samples[0][0] <= capture_ns - self._length_ns:
            self._samples.popleft()

    def clear(self) -> None:
        """Forget all: what was seen before does not belong to what comes."""
        self._samples.clear()

    def still(self, drift_m: float) -> bool:
        """Whether the whole window is filled, and the middles of its two halves lie no farther apart than this."""
        if len(self._samples) < 2 * MIN_SAMPLES:
            return False
        if self._samples[-1][0] - self._samples[0][0] < FILLED * self._length_ns:
            return False
        points = np.array([point for _, point in self._samples])
        half = len(points) // 2
        drift = np.median(points[half:], axis=0) - np.median(points[:half], axis=0)
        return float(np.linalg.norm(drift)) <= drift_m

    def measure(self) -> Midpoint | None:
        """Median and spread; None with fewer than `MIN_SAMPLES` samples."""
        if len(self._samples) < MIN_SAMPLES:
            return None
        points = np.array([point for _, point in self._samples])
        centre = np.median(points, axis=0)
        mad_m = np.median(np.abs(points - centre), axis=0) * MAD_TO_SIGMA
        return Midpoint(centre, float(np.linalg.norm(mad_m)), len(points))


def true_pair(times_s: F64, sensor_m: F64, true_m: F64) -> tuple[Midpoint, F64] | None:
    """One pair from a stretch of samples (n,), (n, 3), (n, 3) of a moving head whose true place is known.

    Returns what the sensor saw, and the true place (3,) in `stack` over the same samples; None with too few.
    A similarity takes means to means, so that motion within the stretch does no harm; samples off the stretch's
    own straight line (Theil and Sen) by far more than the others are left out.
    """
    if len(times_s) < MIN_SAMPLES:
        return None
    centred_s = times_s - times_s.mean()
    fits = [theilslopes(sensor_m[:, axis], centred_s) for axis in range(3)]
    line_m = np.stack([fit.intercept + fit.slope * centred_s for fit in fits], axis=1)
    distance_m = np.linalg.norm(sensor_m - line_m, axis=1)
    limit_m = max(OUTLIER_MADS * MAD_TO_SIGMA * float(np.median(distance_m)), OUTLIER_FLOOR_M)
    good = distance_m <= limit_m
    if good.sum() < MIN_SAMPLES:
        return None
    spread_m = float(np.sqrt((distance_m[good] ** 2).mean()))
    return Midpoint(sensor_m[good].mean(axis=0), spread_m, int(good.sum())), true_m[good].mean(axis=0)
