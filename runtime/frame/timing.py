"""Time of the stages of one turn, on the machine's clock and on the run's."""

from __future__ import annotations

from time import perf_counter_ns

from runtime.clock import NS_PER_MS, Clock, SimulatedClock


class StageTimes:
    """Laps of one turn. On a simulated clock each stage takes what the configuration says, and no more."""

    def __init__(self, clock: Clock, simulated_ms: dict[str, float]) -> None:
        self._clock, self._simulated_ms = clock, simulated_ms
        self.stage_ms: dict[str, float] = {}
        self.measured_ms: dict[str, float] = {}
        self._start_ns = self._last_ns = perf_counter_ns()
        self._left_out_ns = 0

    def lap(self, stage: str) -> None:
        """What happened since the last lap was `stage`."""
        now_ns = perf_counter_ns()
        self._add(stage, (now_ns - self._last_ns) / NS_PER_MS)
        self._last_ns = now_ns

    def laps(self, split_ms: dict[str, float], *, rest: str) -> None:
        """What happened since the last lap was several stages; `rest` takes what they don't account for."""
        now_ns = perf_counter_ns()
        spent_ms = (now_ns - self._last_ns) / NS_PER_MS
        self._last_ns = now_ns
        left_ms = max(0.0, spent_ms - sum(split_ms.values()))
        for stage, stage_ms in split_ms.items():
            self._add(stage, stage_ms + (left_ms if stage == rest else 0.0))

    def leave_out(self) -> None:
        """What happened since the last lap is no part of the turn (measuring quality, say)."""
        now_ns = perf_counter_ns()
        self._left_out_ns += now_ns - self._last_ns
        self._last_ns = now_ns

    def turn_ms(self) -> float:
        """The turn so far, on the machine's clock."""
        return (perf_counter_ns() - self._start_ns - self._left_out_ns) / NS_PER_MS

    def _add(self, stage: str, measured_ms: float) -> None:
        self.measured_ms[stage] = self.measured_ms.get(stage, 0.0) + measured_ms
        if isinstance(self._clock, SimulatedClock):
            # `wait` passes on the simulated clock by itself.
            cost_ms = self._simulated_ms.get(stage, 0.0)
            if stage not in self.stage_ms and stage != "wait":
                self._clock.advance_ns(round(cost_ms * NS_PER_MS))
            self.stage_ms[stage] = cost_ms
        else:
            self.stage_ms[stage] = self.measured_ms[stage]
