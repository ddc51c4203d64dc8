"""Time of the stages of one refresh or one solution, on the machine's clock and on the run's."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter_ns

from runtime.clock import NS_PER_MS, Clock, SimulatedClock

SOLVING_STAGES = ("render", "prepare", "inference", "finish")
STAGES = ("sensor", "track", *SOLVING_STAGES, "present", "wait")


class RefreshTimes:
    """Laps of one refresh. On a simulated clock each stage takes what the configuration says, and time passes."""

    def __init__(self, clock: Clock, simulated_ms: Mapping[str, float]) -> None:
        self._simulated = clock if isinstance(clock, SimulatedClock) else None
        self._simulated_ms = simulated_ms
        self.stage_ms: dict[str, float] = {}
        self.machine_ms: dict[str, float] = {}
        self._start_ns = self._last_ns = perf_counter_ns()

    @property
    def simulated(self) -> bool:
        """True where time passes only as the configuration says."""
        return self._simulated is not None

    def lap(self, stage: str) -> None:
        """What happened since the last lap was `stage`."""
        now_ns = perf_counter_ns()
        self.machine_ms[stage] = self.machine_ms.get(stage, 0.0) + (now_ns - self._last_ns) / NS_PER_MS
        self._last_ns = now_ns
        if self._simulated is None:
            self.stage_ms[stage] = self.machine_ms[stage]
        elif stage not in self.stage_ms:
            cost_ms = self._simulated_ms.get(stage, 0.0)
            if stage != "wait":  # waiting passes on the simulated clock by itself
                self._simulated.advance_ns(round(cost_ms * NS_PER_MS))
            self.stage_ms[stage] = cost_ms

    def overhead_ms(self) -> float:
        """The refresh so far, less presenting and waiting; on the machine's clock."""
        whole_ms = (perf_counter_ns() - self._start_ns) / NS_PER_MS
        return max(0.0, whole_ms - self.machine_ms.get("present", 0.0) - self.machine_ms.get("wait", 0.0))


class Stopwatch:
    """Milliseconds since it was made or last asked, on the machine's clock."""

    def __init__(self) -> None:
        self._last_ns = perf_counter_ns()

    def lap_ms(self) -> float:
        now_ns = perf_counter_ns()
        spent_ms, self._last_ns = (now_ns - self._last_ns) / NS_PER_MS, now_ns
        return spent_ms
