"""Predict when each refresh should wake, present and be displayed, based on vertical blanks.

This module never reads a clock: the caller passes in all times and events. The method follows Monado's compositor
pacing: predict a refresh's times, take in the actual times, and learn from them the phase of the vertical blanks and
how long a refresh needs before a blank.
"""

from __future__ import annotations

from runtime.clock import NS_PER_MS
from runtime.records import FrameTiming

PHASE_GAIN = 0.1  # share of the latest blank's prediction error used to correct the phase
WORK_GAIN = 0.05  # gain for decreases of the estimated work time (0.5 for increases)
HELD_GAIN = 0.01  # the same if drawn frames are held back until they are due, so that few are late
LATE_SHARE = 0.5  # a refresh late by more than this share of a period is moved to the next slot
MARGIN_GROWTH = 1.5  # the margin is multiplied by this after a missed blank
MARGIN_DECAY = 0.9995  # and by this after a met blank: one blank in 800 is missed if MARGIN_MIN_NS is too low
MARGIN_MIN_NS = NS_PER_MS
MOST_WORK = 0.5  # maximum estimate of the work time, in periods
MOST_HELD_WORK = 0.9  # the same if drawn frames are held back until they are due


class Pacer:
    """Schedules refreshes in slots spaced one refresh period apart. Each slot that cannot be met counts
    as missed. A refresh skipped on purpose because the picture has not changed keeps its slot and does not count as
    missed.
    """

    def __init__(self, *, period_ns: int, photon_ns: int, work_ns: int = 0) -> None:
        """Create a pacer for a display. Raises ValueError if the period is not positive. `photon_ns` is the time from
        presenting a refresh to the middle of its time on the display, and `work_ns` an initial estimate of the time
        from waking to presenting.
        """
        if period_ns <= 0:
            raise ValueError("period_ns must be positive")
        self.period_ns, self._photon_ns = period_ns, photon_ns
        self._work_ns = float(work_ns)
        self._margin_ns = float(MARGIN_MIN_NS)
        self._has_blanks = False
        self._holds = False  # True if the output holds drawn frames back
        self._target_ns: int | None = None  # planned present time of the latest refresh
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

    def presented(
        self,
        timing: FrameTiming,
        *,
        woke_ns: int,
        done_ns: int,
        blank_ns: int | None = None,
        held_ns: int | None = None,
    ) -> int:
        """Record what happened to a refresh, and return the best estimate of its display time. `blank_ns` is
        the vertical blank at which it appeared, None if unknown or if the swap was skipped. `held_ns` is how long the
        drawn frame waited until it was due, None if none was drawn or the output never waits.
        """
        self._holds = held_ns is not None or (self._holds and blank_ns is None)
        if held_ns is not None:
            self._has_blanks = False
            self._learn_work(done_ns - woke_ns - held_ns, fall=HELD_GAIN, most=MOST_HELD_WORK)
            return done_ns + self._photon_ns
        if blank_ns is None and self._holds:  # the old picture stays on screen
            return timing.present_ns + self._photon_ns
        if blank_ns is None:
            self._learn_work(done_ns - woke_ns, fall=WORK_GAIN, most=MOST_WORK)
            # If blanks are known, the swap was skipped: the old picture stays on screen, and is on time in its slot.
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
        """Return how much time to allow between waking and presenting, in nanoseconds."""
        return round(self._work_ns + (self._margin_ns if self._has_blanks else 0.0))

    def _learn_work(self, work_ns: int, *, fall: float, most: float) -> None:
        # The gain for increases is also below 1, so that one long refresh does not make later ones wake far too early.
        gain = 0.5 if work_ns > self._work_ns else fall
        bounded = min(work_ns, most * self.period_ns)
        self._work_ns += gain * (bounded - self._work_ns)
