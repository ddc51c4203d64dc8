"""Time of the stages of one refresh or one solution, on the machine's clock and on the run's."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter_ns

from runtime.clock import NS_PER_MS, Clock, SimulatedClock, Stopwatch

SOLVING_STAGES = ("render", "prepare", "inference", "finish")
STAGES = ("sensor", "track", *SOLVING_STAGES, "present", "wait")


class RefreshTimes:
    """Laps of one refresh. On a simulated clock each stage takes what the configuration says, and time passes."""

    def __init__(self, clock: Clock, simulated_ms: Mapping[str, float]) -> None:
        self._simulated = clock if isinstance(clock, SimulatedClock) else None
        self._simulated_ms = simulated_ms
        self.stage_ms: dict[str, float] = {}
        self._watch, self._start_ns = Stopwatch(), perf_counter_ns()

    @property
    def simulated(self) -> bool:
        """True where time passes only as the configuration says."""
        return self._simulated is not None

    def lap(self, stage: str) -> None:
        """What happened since the last lap was `stage`."""
        self._watch.lap(stage)
        if self._simulated is None:
            self.stage_ms[stage] = self._watch.stage_ms[stage]
        elif stage not in self.stage_ms:
            cost_ms = self._simulated_ms.get(stage, 0.0)
            if stage != "wait":  # waiting passes on the simulated clock by itself
                self._simulated.advance_ns(round(cost_ms * NS_PER_MS))
            self.stage_ms[stage] = cost_ms

    def overhead_ms(self) -> float:
        """The refresh so far, less presenting and waiting; on the machine's clock."""
        whole_ms = (perf_counter_ns() - self._start_ns) / NS_PER_MS
        return max(0.0, whole_ms - sum(self._watch.stage_ms.get(stage, 0.0) for stage in ("present", "wait")))
