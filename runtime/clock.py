"""Monotonic clocks that count integer nanoseconds. Every component that needs the time gets one."""

from __future__ import annotations

import select
import time
from collections.abc import Sequence
from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class Clock(Protocol):
    """Interface used to read the time and to sleep, whether the clock is real or simulated."""

    def now_ns(self) -> int:
        """Return the time in nanoseconds on a monotonic clock with an arbitrary zero."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until the deadline, or return immediately if it has passed."""

    def is_readable(self, descriptors: Sequence[int], *, until_ns: int) -> bool:
        """Wait for one of the file descriptors to become readable, until the deadline or up to 1 ms less.
        Return False if none has. Simulated time does not pass, and nothing arrives in it.
        """


class MonotonicClock:
    """Clock that reads the operating system's monotonic time."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        remaining_ns = deadline_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns / NS_PER_S)

    def is_readable(self, descriptors: Sequence[int], *, until_ns: int) -> bool:
        whole_ms = (until_ns - time.monotonic_ns()) // NS_PER_MS  # the system would round up
        if whole_ms <= 0 or not descriptors:
            return False
        poll = select.poll()
        for descriptor in descriptors:
            poll.register(descriptor, select.POLLIN)
        return bool(poll.poll(whole_ms))


class SimulatedClock:
    """Clock for tests and fast replay. Its time passes only when a caller sleeps or advances it."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self._now_ns = max(self._now_ns, deadline_ns)

    def is_readable(self, descriptors: Sequence[int], *, until_ns: int) -> bool:
        return False

    def advance_ns(self, duration_ns: int) -> None:
        """Advance the simulated time. Raises ValueError if the duration is negative."""
        if duration_ns < 0:
            raise ValueError("a monotonic clock cannot run backwards")
        self._now_ns += duration_ns


class Stopwatch:
    """Adds up the real time of named stages, in `stage_ms`. A stage ends with a `lap` of its name."""

    def __init__(self, *stages: str) -> None:
        """Start the first stage. `stages` are listed in `stage_ms` even if they never occur."""
        self.stage_ms = dict.fromkeys(stages, 0.0)
        self._last_ns = time.perf_counter_ns()

    def lap(self, stage: str) -> float:
        """Credit the time elapsed since the previous call to a stage, and return it in milliseconds."""
        now_ns = time.perf_counter_ns()
        spent_ms, self._last_ns = (now_ns - self._last_ns) / NS_PER_MS, now_ns
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + spent_ms
        return spent_ms
