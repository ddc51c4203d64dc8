"""Interpolate the true eye positions at any time between the samples of a recording."""

from __future__ import annotations

from collections import deque

from runtime.clock import NS_PER_S
from runtime.records import F64, Eyes

GAP_NS = NS_PER_S // 5  # maximum gap between samples to interpolate across
KEPT = 512  # maximum number of samples kept, eight seconds at 60 Hz


class TrueEyes:
    """Stores the true eyes from recent samples and interpolates between their capture times."""

    def __init__(self) -> None:
        self._known: deque[tuple[int, F64]] = deque(maxlen=KEPT)
        self._ended = False

    @property
    def is_recorded(self) -> bool:
        """True once a sample has contained true eyes, which are found only in recordings."""
        return bool(self._known)

    def add(self, capture_ns: int, eyes_m: Eyes) -> None:
        """Add a sample's true eyes (2, 3), in the `stack` frame."""
        if not self._known or capture_ns > self._known[-1][0]:
            self._known.append((capture_ns, eyes_m))

    def end(self) -> None:
        """Note that no more samples will arrive."""
        self._ended = True

    def may_come(self, time_ns: int) -> bool:
        """Return True if the true eyes at a given time are not known yet but may be after further samples."""
        return bool(self._known) and time_ns > self._known[-1][0] and not self._ended

    def at(self, time_ns: int) -> F64 | None:
        """Return the true eyes (2, 3) at a given time, or None if they are unknown."""
        if not self._known or time_ns > self._known[-1][0]:
            return None
        after_ns, after_m = self._known[-1]
        for before_ns, before_m in reversed(self._known):
            if before_ns <= time_ns:
                if before_ns == time_ns:
                    return before_m
                if after_ns - before_ns > GAP_NS:
                    return None
                weight = (time_ns - before_ns) / (after_ns - before_ns)
                eyes: F64 = (1 - weight) * before_m + weight * after_m
                return eyes
            after_ns, after_m = before_ns, before_m
        return None
