"""Measure a sensor's noise from the samples of a moving head.

A filter that assumes ten times the actual noise smooths the head's acceleration away, so that its predictions lag. Over
five samples, a head's path is nearly a cubic polynomial, whereas noise is not: the fourth divided difference of the
positions cancels the polynomial and leaves the noise.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from runtime.clock import NS_PER_S
from runtime.records import F64

WINDOW = 5  # samples to a difference
LONGEST_NS = NS_PER_S * 2 // 5  # longest window, because a head may turn within a longer one
KEPT = 64  # number of newest differences kept: two seconds at 30 Hz
FEWEST = 16  # number of differences needed for a measurement
EVERY = 4  # noise changes slowly, so it is measured once in this many samples
MAD_TO_SIGMA = 1.4826  # a normal distribution's standard deviation, divided by its median absolute deviation
LEAST_M = 1e-4  # smallest standard deviation returned, because a head does not move exactly as the filter assumes


class NoiseWatch:
    """Measures the noise of the eye positions that a tracker accepts, by their times. Not thread-safe."""

    def __init__(self) -> None:
        self.sigma_m: F64 | None = None  # (3,) standard deviation of one eye along x, y and z; None: not yet known
        self._newest: deque[tuple[int, F64]] = deque(maxlen=WINDOW)  # capture times and samples
        self._differences = np.zeros((KEPT, 2, 3))
        self._count = 0  # number of differences computed

    def add(self, head_m: F64, *, capture_ns: int) -> None:
        """Update `sigma_m` by the eyes' midpoint and the vector from it to the right eye (2, 3)."""
        self._newest.append((capture_ns, head_m))
        if len(self._newest) < WINDOW or not 0 < capture_ns - self._newest[0][0] <= LONGEST_NS:
            return
        weights = _weights([time_ns for time_ns, _ in self._newest])
        self._differences[self._count % KEPT] = np.tensordot(weights, [sample for _, sample in self._newest], 1)
        self._count += 1
        if self._count >= FEWEST and self._count % EVERY == 0:
            typical = np.median(np.abs(self._differences[: self._count]), axis=0).max(axis=0)
            # If the eyes' errors are independent, an eye has twice the variance of the midpoint and of the vector.
            self.sigma_m = np.maximum(2**0.5 * MAD_TO_SIGMA * typical, LEAST_M)


def _weights(times_ns: list[int]) -> F64:
    """Return the weights of samples in their divided difference, scaled to preserve the noise of a single sample."""
    times = (np.array(times_ns) - times_ns[0]) / (times_ns[-1] - times_ns[0])
    apart = times[:, None] - times + np.eye(len(times))
    weights = 1.0 / apart.prod(axis=1)
    return np.asarray(weights / np.linalg.norm(weights), np.float64)
