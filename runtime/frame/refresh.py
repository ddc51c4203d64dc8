"""Records of one refresh: its data, its times, and the run's status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter_ns

from runtime.clock import NS_PER_MS, Clock, SimulatedClock, Stopwatch
from runtime.config import Settings
from runtime.frame.messages import Facts, Live
from runtime.records import PanelFrame, RefreshAccount, Solution


@dataclass(frozen=True, slots=True)
class Refresh:
    """A refresh's data, as passed to observers."""

    account: RefreshAccount
    frame: PanelFrame
    solution: Solution | None  # the latest solution at the time of this refresh
    state_version: int = 0  # the solver's state at this refresh (`Facts.version`)


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Status of a run as of its latest refresh, from which answers, pages and files are made."""

    refresh: Refresh
    name: str  # of the state, such as `degraded: sensor`
    reason: str
    missing: Mapping[str, str]  # reason for each failed part
    paused: bool
    flat_asked: bool
    settings: Settings  # used by the presenter; the solver's are in `facts`
    facts: Facts
    live: Live
    people_in_view: int  # whether or not they are served
    rejected_samples: Mapping[str, int]  # by reason, since the start
    sensor_hz: float | None  # None: unknown, or the sensor has failed
    stale_inputs: int  # samples that were superseded before use


class RefreshTimes:
    """Measures each stage of a refresh, or advances a simulated clock by the configured time."""

    def __init__(self, clock: Clock, simulated_ms: Mapping[str, float]) -> None:
        self._simulated = clock if isinstance(clock, SimulatedClock) else None
        self._simulated_ms = simulated_ms
        self.stage_ms: dict[str, float] = {}
        self._watch, self._start_ns = Stopwatch(), perf_counter_ns()

    @property
    def simulated(self) -> bool:
        """True if time advances only by configured durations."""
        return self._simulated is not None

    def lap(self, stage: str) -> None:
        """Record the time since the last lap as the time taken by `stage`."""
        self._watch.lap(stage)
        if self._simulated is None:
            self.stage_ms[stage] = self._watch.stage_ms[stage]
        elif stage not in self.stage_ms:
            cost_ms = self._simulated_ms.get(stage, 0.0)
            if stage != "wait":  # while waiting, the simulated clock has advanced anyway
                self._simulated.advance_ns(round(cost_ms * NS_PER_MS))
            self.stage_ms[stage] = cost_ms

    def hold(self, held_ns: int) -> None:
        """Count a part of the stage `present` as `wait`, because the drawn frame was held back."""
        self.stage_ms["present"] -= held_ns / NS_PER_MS
        self.stage_ms["wait"] = self.stage_ms.get("wait", 0.0) + held_ns / NS_PER_MS

    def overhead_ms(self) -> float:
        """Return the refresh's time on the machine's clock in ms, without presenting and waiting."""
        whole_ms = (perf_counter_ns() - self._start_ns) / NS_PER_MS
        return max(0.0, whole_ms - sum(self._watch.stage_ms.get(stage, 0.0) for stage in ("present", "wait")))
