"""Predict the wake, present and display times of refreshes from vertical blanks.

The module never reads a clock. Its callers pass in all times and events. The scheme follows the compositor pacing of
Monado: it predicts the times of a refresh, receives the actual times, and learns the phase of the vertical blanks and
the time that a refresh needs before a blank.
"""

from __future__ import annotations

from runtime.clock import NS_PER_MS
from runtime.records import FrameTiming

PHASE_GAIN = 0.1  # share of the prediction error of the newest blank by which the phase is corrected
WORK_GAIN = 0.05  # gain of decreases of the estimated work time (increases have gain 0.5)
LATE_SHARE = 0.5  # a refresh that is late by more than this share of a period moves to the next slot
MARGIN_GROWTH = 1.5  # factor on the margin after a missed blank
MARGIN_DECAY = 0.9995  # factor on the margin after a met blank; one blank in 800 is missed if MARGIN_MIN_NS is too low
MARGIN_MIN_NS = NS_PER_MS


class Pacer:
    """Schedules refreshes in slots that are one refresh period apart.

    Slots that cannot be met count as missed. A refresh that is skipped on purpose, because the picture has not changed,
    keeps its slot and does not count as missed.
    """

    def __init__(self, *, period_ns: int, photon_ns: int, work_ns: int = 0) -> None:
        """Create a pacer for a display.

        Args:
            period_ns: Refresh period of the display.
            photon_ns: Time from presenting to the middle of the display time.
            work_ns: Initial estimate of the time from waking to presenting.

        Raises:
            ValueError: The period is not positive.
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
        """Schedule the next refresh and return its predicted times."""
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

        Args:
            timing: Predicted times of the refresh.
            woke_ns: Time at which the refresh woke.
            done_ns: Time at which presenting was done.
            blank_ns: Time of the vertical blank of the refresh. None if the display driver does not report the blank or
                skipped the swap.
        """
        if blank_ns is None:
            self._learn_work(done_ns - woke_ns)
            # If blanks are known, a skipped swap keeps the old picture on screen until the slot of the refresh.
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
        """Return the time in nanoseconds to allow between waking and presenting."""
        return round(self._work_ns + (self._margin_ns if self._has_blanks else 0.0))

    def _learn_work(self, work_ns: int) -> None:
        # A gain below 1 for increases limits how early later refreshes wake after a single long refresh.
        gain = 0.5 if work_ns > self._work_ns else WORK_GAIN
        bounded = min(work_ns, self.period_ns // 2)
        self._work_ns += gain * (bounded - self._work_ns)
