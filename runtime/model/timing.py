"""Where a prediction's time goes."""

from __future__ import annotations

from time import perf_counter_ns

NS_PER_MS = 1e6


class Stopwatch:
    """Adds the time since the last lap to a named stage."""

    def __init__(self) -> None:
        self.stage_ms = {"prepare": 0.0, "inference": 0.0, "finish": 0.0}
        self._last_ns = perf_counter_ns()

    def lap(self, stage: str) -> None:
        """What happened since the last lap was `stage`."""
        now_ns = perf_counter_ns()
        self.stage_ms[stage] += (now_ns - self._last_ns) / NS_PER_MS
        self._last_ns = now_ns
