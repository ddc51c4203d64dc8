"""Measure a sensor's noise from the samples of a moving head.

A filter that assumes ten times the actual noise smooths the head's acceleration away, so that its predictions lag. Over
five samples, a head's path is nearly a cubic polynomial, whereas noise is not: the fourth divided difference of the
positions cancels the polynomial and leaves the noise.
"""

from __future__ import annotations

import numpy as np

from runtime.clock import NS_PER_S
from runtime.records import F64

WINDOW = 5  # samples to a difference
LONGEST_NS = NS_PER_S * 2 // 5  # samples farther apart than this are no window, because a head may turn in between
KEPT = 64  # number of newest differences kept: two seconds at 30 Hz
FEWEST = 16  # number of differences needed for a measurement
EVERY = 4  # noise changes slowly, so it is measured once in this many samples
MAD_TO_SIGMA = 1.4826  # a normal distribution's standard deviation, divided by its median absolute deviation
LEAST_M = 1e-4  # smallest standard deviation returned, because a head does not move exactly as the filter assumes


class NoiseWatch:
    """Measures the noise of the eye positions that a tracker accepts.

    Not thread-safe. The time is taken from the samples; no clock is read.
    """

    def __init__(self) -> None:
        self.sigma_m: F64 | None = None  # (3,) standard deviation of one eye along x, y and z; None: not yet known
        self._times_ns: list[int] = []  # capture times of the newest samples, at most WINDOW
        self._places: list[F64] = []  # (2, 3) midpoint and half vector of each of these samples
        self._differences = np.zeros((KEPT, 2, 3))
        self._count = 0  # differences so far

    def add(self, middle_m: F64, half_m: F64, *, capture_ns: int) -> None:
        """Add an accepted sample and update `sigma_m`.

        Args:
            middle_m: (3,) midpoint of the eyes.
            half_m: (3,) vector from the midpoint to the right eye.
            capture_ns: The sample's capture time.
        """
        self._times_ns, self._places = [*self._times_ns, capture_ns][-WINDOW:], [*self._places, np.stack([middle_m, half_m])][-WINDOW:]
        span_ns = capture_ns - self._times_ns[0]
        if len(self._times_ns) < WINDOW or not 0 < span_ns <= LONGEST_NS:
            return
        self._differences[self._count % KEPT] = np.tensordot(_weights(self._times_ns), np.stack(self._places), 1)
        self._count += 1
        if self._count >= FEWEST and self._count % EVERY == 0:
            # The midpoint and the half vector each have half the variance of an eye if the eyes' errors are independent.
            typical = np.median(np.abs(self._differences[: self._count]), axis=0).max(axis=0)
            self.sigma_m = np.maximum(2**0.5 * MAD_TO_SIGMA * typical, LEAST_M)


def _weights(times_ns: list[int]) -> F64:
    """Return the weights of samples in their divided difference, scaled to preserve the noise of a single sample."""
    times = (np.array(times_ns) - times_ns[0]) / (times_ns[-1] - times_ns[0])
    apart = times[:, None] - times + np.eye(len(times))
    weights = 1.0 / apart.prod(axis=1)
    return np.asarray(weights / np.linalg.norm(weights), np.float64)
