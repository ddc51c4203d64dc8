"""Detect a head at rest from the samples accepted by the tracker.

Predictions jitter by several times the sensor's noise, because predicting ahead amplifies noise in the velocity. At
rest, the best estimate of the position is the samples' median, and the picture can stand still.
"""

from __future__ import annotations

import numpy as np

from runtime.clock import NS_PER_S
from runtime.eyes.noise import MAD_TO_SIGMA
from runtime.records import F64, Eyes

REST_NS = NS_PER_S  # a head counts as at rest if it has not moved for this long
LOST_NS = NS_PER_S  # a longer gap between samples than this resets the detector
DRIFT_NS = 3 * NS_PER_S  # time span of the median used to measure drift
EVERY = 8  # noise and drift change slowly, so they are measured once in this many samples
FEWEST = 8  # minimum number of samples needed to conclude anything
KEPT = 256  # number of samples kept for a head at rest
GRACE_M = 0.0003  # added to every threshold, for sensors without noise
NOISE_MAX_M = 0.005  # with more noise than this, no head counts as at rest, because it could move off unnoticed
# Thresholds in standard deviations of one sample. At 60 samples a second, white noise exceeds each of them only once in
# hours.
SINGLE = 4.5  # for two consecutive samples that deviate in the same direction
MEDIAN_OF_FIVE = 2.6  # for the median of the newest five samples
HALVES = 4.5  # for the difference between the two halves of the samples, in its own standard deviations
MEDIAN_EFFICIENCY = 1.25  # a median's standard deviation, divided by a mean's
LEVER_M = 0.15  # RMS distance from the centre to the points on a display half a metre wide
NEAREST_M = 0.1  # smaller distances from the display are raised to this


class RestWatch:
    """Detector of whether a head is at rest, and where. Not thread-safe. Never reads a clock."""

    def __init__(self, *, max_drift_m: float) -> None:
        """Create a detector that follows a resting head if the drift exceeds the noise by `max_drift_m`."""
        self._max_drift_m = max_drift_m
        self._times = np.zeros(2 * KEPT, np.int64)
        self._eyes = np.zeros((2 * KEPT, 2, 3))
        self._count = 0
        self.place: F64 | None = None  # (2, 3) eyes at rest, a new array each time; None while the head moves
        self.noise_m = np.zeros(3)  # standard deviation of one eye's sample, in the terms of `_shifts`
        self.sigma_m = 0.0  # standard deviation of `place` along an axis, including undetected drift

    def update(self, eyes_m: Eyes, *, capture_ns: int) -> None:
        """Add a sample and update `place`."""
        if self._count and not 0 < capture_ns - self._times[self._count - 1] < LOST_NS:
            self.forget()
        self._append(eyes_m, capture_ns)
        if self._count < FEWEST:
            return
        if self.place is None:
            if self._stands():
                self._settle(capture_ns - REST_NS)
            return
        slow_checks = self._count % EVERY == 0
        if slow_checks:
            self._measure_noise()
        if slow_checks and self.noise_m.max() > NOISE_MAX_M:
            self.place = None
        elif self._left(self.place):
            # Samples taken before a motion do not help to detect when it ends.
            self._keep_last(2)
            self.place = None
        elif slow_checks and self._drifted(self.place):
            self._settle(capture_ns - DRIFT_NS)

    def forget(self) -> None:
        """Discard all samples, because the face was lost or the clock jumped."""
        self._count, self.place = 0, None

    def _append(self, eyes_m: Eyes, capture_ns: int) -> None:
        if self._count == len(self._times):
            self._keep_last(KEPT)
        self._times[self._count], self._eyes[self._count] = capture_ns, eyes_m
        self._count += 1

    def _keep_last(self, count: int) -> None:
        first = self._count - count
        self._times[:count] = self._times[first : self._count]
        self._eyes[:count] = self._eyes[first : self._count]
        self._count = count

    def _since(self, time_ns: int) -> F64:
        """Return the (n, 2, 3) samples since `time_ns`, but at least the newest `FEWEST`."""
        first = min(int(self._times[: self._count].searchsorted(time_ns)), self._count - FEWEST)
        return self._eyes[first : self._count]

    def _settle(self, since_ns: int) -> None:
        recent = self._since(since_ns)
        self.place = _median(recent)
        noise_m = float(self.noise_m.max())
        median_sigma_m = MEDIAN_EFFICIENCY * noise_m / len(recent) ** 0.5
        # `_drifted` does not detect a drift up to this value.
        drift_m = self._max_drift_m + 2 * MEDIAN_EFFICIENCY * noise_m * (4 / max(len(recent), FEWEST)) ** 0.5
        self.sigma_m = float(np.hypot(median_sigma_m, drift_m / 2**0.5))  # drift mostly goes in one direction

    def _measure_noise(self) -> None:
        """Measure noise as each sample's distance from the line between its neighbours, also during steady motion."""
        first = max(0, self._count - KEPT // 2)
        times, shifts = self._times[first : self._count], _shifts(self._eyes[first : self._count], self._eyes[first])
        later = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None, None]  # neighbours may be missing
        off = shifts[1:-1] - (1 - later) * shifts[:-2] - later * shifts[2:]
        off /= np.sqrt(1 + later**2 + (1 - later) ** 2)
        deep, right, up = MAD_TO_SIGMA * _median(np.abs(off)).max(axis=0)
        self.noise_m = np.array([deep, max(right, up), max(right, up)])

    def _stands(self) -> bool:
        """Return True if the last second's two halves agree with each other and with the newest samples."""
        now_ns = int(self._times[self._count - 1])
        if now_ns - self._times[0] < REST_NS:
            return False
        recent = self._since(now_ns - REST_NS)
        half = len(recent) // 2
        shifts = _shifts(recent, recent[-1])
        apart_m = np.abs(_median(shifts[half:]) - _median(shifts[:half]))
        tolerance = HALVES * MEDIAN_EFFICIENCY * (2 / half) ** 0.5
        # Most motion exceeds the limit for any accepted noise, and measuring the noise takes longer than this check.
        if apart_m.max() > tolerance * NOISE_MAX_M + GRACE_M:
            return False
        self._measure_noise()
        if self.noise_m.max() > NOISE_MAX_M or (apart_m > tolerance * self.noise_m + GRACE_M).any():
            return False
        return not self._left(_median(recent))

    def _left(self, place: F64) -> bool:
        """Return True if the newest samples deviate from `place` by more than noise can explain."""
        shifts = _shifts(self._eyes[self._count - 5 : self._count], place)
        last, newest = shifts[-2:]
        reach = SINGLE * self.noise_m + GRACE_M
        # Outliers deviate in random directions, so two consecutive samples must deviate in the same direction.
        together = np.maximum(np.minimum(last, newest), np.minimum(-last, -newest)) > reach
        beyond = np.abs(_median(shifts)) > MEDIAN_OF_FIVE * self.noise_m + GRACE_M
        return bool((together | beyond).any())

    def _drifted(self, place: F64) -> bool:
        now_ns = int(self._times[self._count - 1])
        if now_ns - self._times[0] < DRIFT_NS:
            return False
        recent = self._since(now_ns - DRIFT_NS)
        shift = _shifts(_median(recent), place)
        # `place` is the median of a third as many samples.
        shift_sigma_m = MEDIAN_EFFICIENCY * self.noise_m * (4 / len(recent)) ** 0.5
        return bool((np.abs(shift) > self._max_drift_m + 2 * shift_sigma_m).any())


def _median(samples: F64) -> F64:
    """Return the median along the first axis. For so few samples, `np.median` takes ten times as long."""
    ordered, count = np.sort(samples, axis=0), len(samples)
    median: F64 = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
    return median


def _shifts(eyes_m: Eyes, place: F64) -> F64:
    """Return the (..., 2, 3) displacements in metres of samples (..., 2, 3) from a place (2, 3), as seen on the
    display. Each eye has three: the effect of a change in the eye's distance on points away from the display's centre,
    and to the right and up, as seen from the centre.
    """
    shifts = eyes_m - place
    away, sideways = shifts[..., :1], shifts[..., 1:]
    distance = np.maximum(place[:, :1], NEAREST_M)
    sideways -= away * (place[:, 1:] / distance)
    away *= LEVER_M / distance
    return shifts
