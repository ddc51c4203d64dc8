"""Drift while it runs: a viewer whose eye separation is known is a ruler for the calibration's scale."""

from __future__ import annotations

from collections import deque

import numpy as np

from runtime.records import EyePoints

TOLERANCE = 0.04  # by which the measured separation may part from the known one
SAMPLES = 300  # ten seconds of a common depth camera
SAMPLES_MIN = 90
CONFIDENCE_MIN = 0.5
SURE = 3.0  # standard errors of the median by which it must be beyond the tolerance
MAD_TO_SIGMA = 1.4826
MEDIAN_EFFICIENCY = 1.2533  # standard error of a median over that of a mean, Gaussian


class SeparationWatch:
    """Compares the measured separation of the eyes with the known one."""

    def __init__(self, *, known_ipd_m: float) -> None:
        """A known separation of 0 watches nothing."""
        self._known_m = known_ipd_m
        self._samples: deque[float] = deque(maxlen=SAMPLES)
        self.warning = ""  # what is wrong at present; empty: nothing

    @property
    def ratio(self) -> float | None:
        """Measured over known separation, the median of the last samples; None before there are enough."""
        if self._known_m <= 0.0 or len(self._samples) < SAMPLES_MIN:
            return None
        return float(np.median(self._samples)) / self._known_m

    def update(self, eyes: EyePoints) -> str:
        """Take in eyes in frame `stack`. Answers a line to log when the state changes, else an empty text."""
        if self._known_m <= 0.0 or eyes.completed or float(eyes.confidence.min()) < CONFIDENCE_MIN:
            return ""
        separation_m = float(np.linalg.norm(eyes.eyes_m[0] - eyes.eyes_m[1]))
        if not np.isfinite(separation_m):
            return ""
        self._samples.append(separation_m)
        ratio = self.ratio
        if ratio is None:
            return ""
        return self._judged(ratio)

    def _judged(self, ratio: float) -> str:
        values = np.array(self._samples) / self._known_m
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(values - ratio)))
        doubt = SURE * MEDIAN_EFFICIENCY * sigma / np.sqrt(len(values))
        off = abs(ratio - 1.0)
        if not self.warning and off > TOLERANCE + doubt:
            self.warning = (
                f"calibration: the eyes measure {ratio * self._known_m * 1e3:.1f} mm apart, known "
                f"{self._known_m * 1e3:.1f} mm ({(ratio - 1) * 100:+.1f}%): another viewer, or calibrate again"
            )
            return self.warning
        if self.warning and off < TOLERANCE / 2:
            self.warning = ""
            return "calibration: the eyes' separation is right again"
        return ""
