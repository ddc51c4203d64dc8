"""Pacing: wake, present and display times of refreshes, predicted from vertical blanks.

Pure: it is given the time and what happened, and never reads a clock. The manner is that of Monado's compositor
pacing: predict, report what happened, learn the phase of the blanks and the time that a refresh needs before one.
"""

from __future__ import annotations

from runtime.clock import NS_PER_MS
from runtime.records import FrameTiming

PHASE_GAIN = 0.1  # of the newest blank's error in the predicted phase
WORK_GAIN = 0.05  # with which the time a refresh needs is forgotten; more is believed at once
LATE_SHARE = 0.5  # of a period: later than this, the next slot is taken
MARGIN_GROWTH = 1.5  # of the margin after a missed blank
MARGIN_DECAY = 0.9995  # of the margin after a blank that was met: where drawing needs more, one in 800 is missed
MARGIN_MIN_NS = NS_PER_MS


class Pacer:
    """One refresh after the other on a grid of one period; slots that can't be met are counted as missed.

    A refresh that was left out on purpose (the same picture again) keeps its slot and is no missed blank.
    """

    def __init__(self, *, period_ns: int, photon_ns: int, work_ns: int = 0) -> None:
        """photon_ns: from presenting to the middle of the light; work_ns: first guess of waking to presented."""
        if period_ns <= 0:
            raise ValueError("a period must be positive")
        self.period_ns, self._photon_ns = period_ns, photon_ns
        self._work_ns = float(work_ns)
        self._margin_ns = float(MARGIN_MIN_NS)
        self._has_blanks = False
        self._target_ns: int | None = None  # of the last refresh
        self._number = -1
        self.missed = 0

    def predict(self, now_ns: int) -> FrameTiming:
        """The next refresh."""
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
        """What became of a refresh; answers its display time, as well as that is known.

        blank_ns: when its vertical blank happened; None where the sink does not know, or left the swap out.
        """
        if blank_ns is None:
            self._learn_work(done_ns - woke_ns)
            # Where blanks are known, a swap that was left out shows the old picture until its slot.
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
        """From waking to the instant of presenting."""
        return round(self._work_ns + (self._margin_ns if self._has_blanks else 0.0))

    def _learn_work(self, work_ns: int) -> None:
        # More work is believed by halves, so that one long refresh does not wake all others early.
        gain = 0.5 if work_ns > self._work_ns else WORK_GAIN
        bounded = min(work_ns, self.period_ns // 2)
        self._work_ns += gain * (bounded - self._work_ns)
