"""Did the eyes move? A dead band from the tracker's own noise, and a drift that stays inside it. No clock, no I/O."""

from __future__ import annotations

from collections import deque

import numpy as np

from runtime.clock import NS_PER_S
from runtime.records import F64

WINDOW_NS = NS_PER_S  # over which noise is told from motion
FEWEST = 8  # estimates in it, before anything is said to be noise
SIGMAS = 4.0  # a single estimate beyond so many is motion
BAND_SIGMAS = 3.0  # of a single estimate's noise: the mean of a window stays well inside
LEAST_BAND_M = 0.0002


def lateral_shift_m(eyes_m: F64, other_m: F64) -> float:
    """How far two eye positions (2, 3) differ as the panels show it, metres at the first eyes' distance; the worse eye.

    What an eye sees depends on the slopes y/x and z/x of its rays: a step straight towards the display counts
    only as far as it changes them.
    """
    slopes, others = eyes_m[:, 1:] / eyes_m[:, :1], other_m[:, 1:] / other_m[:, :1]
    return float((np.linalg.norm(slopes - others, axis=1) * eyes_m[:, 0]).max())


class ReuseGate:
    """Says whether a frame that was solved for some eyes will do for the present ones.

    It will while the mean of the last second lies within the band of the solved eyes, and no single
    estimate leaves it by more than noise can. The band is measured from the eyes that were solved, not from the
    last turn, so that slow drift can't accumulate.
    """

    def __init__(self, *, most_m: float, band_m: float | None = None) -> None:
        """most_m: the widest band; band_m: a fixed one instead of the noise's own."""
        self._most_m, self._fixed_m = most_m, band_m
        self._recent: deque[tuple[int, F64]] = deque()
        self._solved: F64 | None = None
        self.noise_m = 0.0  # standard deviation of one estimate, laterally
        self.band_m = band_m or LEAST_BAND_M

    def may_reuse(self, eyes_m: F64, *, time_ns: int) -> bool:
        """True where the last solved eyes are still good for these (2, 3). Tell `solved` when they are solved for."""
        self._recent.append((time_ns, eyes_m))
        while self._recent[0][0] < time_ns - WINDOW_NS:
            self._recent.popleft()
        self._measure_noise()
        if self._solved is None:
            return False
        if not self._is_noise(lateral_shift_m(self._solved, eyes_m)):
            return False
        mean = np.mean([eyes for _, eyes in self._recent], axis=0)
        return lateral_shift_m(self._solved, mean) <= self.band_m

    def best_guess(self, eyes_m: F64) -> F64:
        """The eyes to solve for: the recent mean while nothing but noise moves them, else the newest.

        An estimate that noise threw far off must not be solved for: the next ones would be as far from it again.
        """
        if len(self._recent) < FEWEST:
            return eyes_m
        mean: F64 = np.mean([eyes for _, eyes in self._recent], axis=0)
        return mean if self._is_noise(lateral_shift_m(mean, eyes_m)) else eyes_m

    def solved(self, eyes_m: F64) -> None:
        """The frame on the panels is now for these eyes."""
        self._solved = eyes_m.copy()

    def forget(self) -> None:
        """Nothing solved is good any more: the content, the model or the settings changed."""
        self._solved = None

    def _is_noise(self, shift_m: float) -> bool:
        """True where a single estimate so far off the head's place says nothing of motion."""
        return shift_m <= self.band_m + SIGMAS * min(self.noise_m, self._most_m / SIGMAS)

    def _measure_noise(self) -> None:
        """What remains of the recent slopes when a straight motion is taken out of them."""
        if len(self._recent) < FEWEST:
            return
        times = np.array([time_ns for time_ns, _ in self._recent], dtype=np.float64)
        eyes = np.array([eyes for _, eyes in self._recent])
        slopes = (eyes[..., 1:] / eyes[..., :1]).reshape(len(eyes), -1)
        centred = times - times.mean()
        spread = float((centred**2).sum())
        trend = (centred @ slopes) / spread if spread else np.zeros(slopes.shape[1])
        rest = slopes - slopes.mean(axis=0) - centred[:, None] * trend
        deviation = np.sqrt((rest**2).sum(axis=0) / max(len(eyes) - 2, 1)).reshape(2, 2)
        self.noise_m = float((np.linalg.norm(deviation, axis=1) * eyes[-1, :, 0]).max())
        if self._fixed_m is None:
            self.band_m = float(np.clip(BAND_SIGMAS * self.noise_m, LEAST_BAND_M, self._most_m))
