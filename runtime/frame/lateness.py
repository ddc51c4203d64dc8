"""Whether the refreshes come too late for the display, in a few words for the state's reason."""

from __future__ import annotations

from collections import deque

from runtime.clock import NS_PER_S

WINDOW_NS = NS_PER_S
LATE_SHARE = 0.9  # of the refreshes that a second should have: with fewer it is late
WELL_SHARE = 0.95  # with so many it is late no more
REFRESHES_MAX = 1024  # in the window


class Lateness:
    """Fed once a refresh. Late: for a second on end, the second before had too few refreshes."""

    def __init__(self, period_ns: int) -> None:
        self._wanted = WINDOW_NS / period_ns
        self._shown_ns: deque[int] = deque(maxlen=REFRESHES_MAX)
        self._begun_ns: int | None = None
        self._few_since_ns: int | None = None
        self._told = ""
        self._told_ns = 0

    def update(self, *, presented: bool, now_ns: int) -> str:
        """Empty: in time. Otherwise `late: 38 of 60 refreshes a second`; the figure is renewed once a second."""
        if self._begun_ns is None:
            self._begun_ns = now_ns
        if presented:
            self._shown_ns.append(now_ns)
        while self._shown_ns and self._shown_ns[0] <= now_ns - WINDOW_NS:
            self._shown_ns.popleft()
        if now_ns - self._begun_ns < WINDOW_NS:
            return ""
        count = len(self._shown_ns)
        if count >= (WELL_SHARE if self._told else LATE_SHARE) * min(self._wanted, REFRESHES_MAX) - 1:
            self._few_since_ns, self._told = None, ""
        elif self._few_since_ns is None:
            self._few_since_ns = now_ns
        elif now_ns - self._few_since_ns > WINDOW_NS and (not self._told or now_ns - self._told_ns >= WINDOW_NS):
            self._told, self._told_ns = f"late: {count} of {self._wanted:.0f} refreshes a second", now_ns
        return self._told
