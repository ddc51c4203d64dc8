"""The One Euro filter (Casiez, Roussel, Vogel, CHI 2012): a low-pass whose cut-off rises with speed."""

from __future__ import annotations

import math

import numpy as np

from runtime.records import F64


def smoothing(dt_s: float, *, cutoff_hz: float) -> float:
    """Weight of a new sample in an exponential filter of this cut-off frequency."""
    turn = 2 * math.pi * cutoff_hz * dt_s
    return turn / (turn + 1)


class OneEuro:
    """Filters a vector. Speed is taken over all axes together, so that the filter turns with its frame."""

    def __init__(self, *, min_cutoff_hz: float = 1.0, beta: float = 10.0, speed_cutoff_hz: float = 1.0) -> None:
        """beta: Hz of cut-off per metre and second (the paper's, in its units)."""
        self._min_hz, self._beta, self._speed_hz = min_cutoff_hz, beta, speed_cutoff_hz
        self.position: F64 | None = None
        self.velocity: F64 = np.zeros(0)

    def update(self, measured: F64, *, dt_s: float) -> F64:
        """(...) the filtered positions; dt_s > 0 since the sample before, of no meaning for the first."""
        if self.position is None:
            self.position, self.velocity = measured.copy(), np.zeros_like(measured)
            return self.position
        speed = (measured - self.position) / dt_s
        self.velocity = self.velocity + (speed - self.velocity) * smoothing(dt_s, cutoff_hz=self._speed_hz)
        cutoff_hz = self._min_hz + self._beta * float(np.linalg.norm(self.velocity))
        self.position = self.position + (measured - self.position) * smoothing(dt_s, cutoff_hz=cutoff_hz)
        return self.position

    def reset(self) -> None:
        """Start anew with the next sample."""
        self.position = None
