"""Monotonic clocks in integer nanoseconds, which are passed to every component that needs the time."""

from __future__ import annotations

import time
from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class Clock(Protocol):
    """Interface through which the runtime reads the time, from a real or a simulated clock."""

    def now_ns(self) -> int:
        """Return the time in nanoseconds on a monotonic clock with an arbitrary zero."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until the deadline, or return immediately if it has passed."""


class MonotonicClock:
    """Clock that reads the monotonic time of the operating system."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        remaining_ns = deadline_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns / NS_PER_S)


class SimulatedClock:
    """Clock for tests and fast replay, whose time passes only when a caller sleeps or advances the clock."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self._now_ns = max(self._now_ns, deadline_ns)

    def advance_ns(self, duration_ns: int) -> None:
        """Advance the simulated time. Raises ValueError if the duration is negative."""
        if duration_ns < 0:
            raise ValueError("a monotonic clock cannot run backwards")
        self._now_ns += duration_ns


class Stopwatch:
    """Stopwatch that adds up the real time spent in named stages, in milliseconds.

    A stage begins when the previous stage ends, and ends when `lap` is called with the name of the stage. The totals
    are in `stage_ms`.
    """

    def __init__(self, *stages: str) -> None:
        """Start the first stage.

        Args:
            stages: Names of stages to list in `stage_ms` even if they never occur.
        """
        self.stage_ms = dict.fromkeys(stages, 0.0)
        self._last_ns = time.perf_counter_ns()

    def lap(self, stage: str) -> float:
        """Add the time since the previous call to a stage, and return that time in milliseconds."""
        now_ns = time.perf_counter_ns()
        spent_ms, self._last_ns = (now_ns - self._last_ns) / NS_PER_MS, now_ns
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + spent_ms
        return spent_ms
