"""Predict the wake, present and display times of refreshes from vertical blanks.

Callers pass in times and events; this module reads no clock. The scheme follows Monado's compositor pacing: it predicts
a refresh, receives its events, and learns the phase of the blanks and the time that a refresh needs before one.
"""

from __future__ import annotations

from runtime.clock import NS_PER_MS
from runtime.records import FrameTiming

PHASE_GAIN = 0.1  # share of the newest blank's prediction error by which the phase is corrected
WORK_GAIN = 0.05  # decay of the work-time estimate (increases use gain 0.5)
LATE_SHARE = 0.5  # a refresh that is late by more than this share of a period moves to the next slot
MARGIN_GROWTH = 1.5  # factor on the margin after a missed blank
MARGIN_DECAY = 0.9995  # factor per met blank; if drawing exceeds the minimum margin, one blank in 800 is missed
MARGIN_MIN_NS = NS_PER_MS


class Pacer:
    """Scheduler of refreshes on a grid of one period. Slots that cannot be met count as missed.

    A refresh that is skipped on purpose (unchanged picture) keeps its slot and does not count as missed.
    """

    def __init__(self, *, period_ns: int, photon_ns: int, work_ns: int = 0) -> None:
        """Create a pacer for a display with this refresh period.

        photon_ns: time from presenting to the middle of the display time. work_ns: first estimate of the time from
        waking to presenting.
        """
        if period_ns <= 0:
            raise ValueError("period_ns must be positive")
        self.period_ns, self._photon_ns = period_ns, photon_ns
        self._work_ns = float(work_ns)
        self._margin_ns = float(MARGIN_MIN_NS)
        self._has_blanks = False
        self._target_ns: int | None = None  # target of the last refresh
        self._number = -1
        self.missed = 0

    def predict(self, now_ns: int) -> FrameTiming:
        """Return the timing of the next refresh."""
        lead_ns = self._lead_ns()
        if self._target_ns is None:
            target_ns = now_ns + lead_ns
        else:
            target_ns = self._target_ns + self.period_ns
            late_ns = now_ns - (target_ns - lead_ns)
            if late_ns > LATE_SHARE * self.period_ns:
                skipped = -(-int(late_ns - LATE_SHARE * self.period_ns) // self.period_ns)
                self.missed += skipped
                target_ns += skipped * self.period_ns
        self._target_ns = target_ns
        self._number += 1
        return FrameTiming(self._number, target_ns - lead_ns, target_ns, target_ns + self._photon_ns)

    def presented(self, timing: FrameTiming, *, woke_ns: int, done_ns: int, blank_ns: int | None = None) -> int:
        """Record the outcome of a refresh, and return the best estimate of its display time.

        woke_ns, done_ns: times at which it woke and had presented. blank_ns: time of its vertical blank; None if the
        display driver does not know it or skipped the swap.
        """
        if blank_ns is None:
            self._learn_work(done_ns - woke_ns)
            # With known blanks, a skipped swap keeps the old picture on screen until its slot.
            return (timing.present_ns if self._has_blanks else done_ns) + self._photon_ns
        self._has_blanks = True
        error_ns = blank_ns - timing.present_ns
        slots = round(error_ns / self.period_ns)
        if slots > 0:
            self.missed += slots
            self._margin_ns = min(self._margin_ns * MARGIN_GROWTH, self.period_ns / 2)
        else:
            self._margin_ns = max(self._margin_ns * MARGIN_DECAY, float(MARGIN_MIN_NS))
        remaining_ns = error_ns - slots * self.period_ns
        assert self._target_ns is not None
        self._target_ns += slots * self.period_ns + round(PHASE_GAIN * remaining_ns)
        return blank_ns + self._photon_ns

    def _lead_ns(self) -> int:
        """Return how long before presenting a refresh must wake."""
        return round(self._work_ns + (self._margin_ns if self._has_blanks else 0.0))

    def _learn_work(self, work_ns: int) -> None:
        # Increases have gain 0.5, so that a single long refresh does not make all later ones wake early.
        gain = 0.5 if work_ns > self._work_ns else WORK_GAIN
        bounded = min(work_ns, self.period_ns // 2)
        self._work_ns += gain * (bounded - self._work_ns)
