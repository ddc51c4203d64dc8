"""Where a solver runs: the presenter's view of it, and the host of simulated time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol

from runtime.clock import NS_PER_MS, Clock
from runtime.frame.solver import SolverUpdate
from runtime.records import SolveRequest

FIRST_REQUEST = SolveRequest(0, None, "none", 0.0, flat_wanted=True)  # before the first refresh: the flat picture
SOLVING_STAGES = ("render", "prepare", "inference", "finish")
COST_GAIN = 0.2  # of the newest solution in the running mean of what one costs


class SolverParts(Protocol):
    """A solver and what belongs to its thread, such as a GL context."""

    def step(self, request: SolveRequest) -> SolverUpdate:
        """One request."""

    def simulated_stage_ms(self) -> Mapping[str, float]:
        """What each stage costs on a simulated clock at present."""

    def close(self) -> None:
        """Release everything that no other solver uses by now, on the thread that made it."""


Task = Callable[[SolverParts], bool]  # done on the solver's thread between two steps, until it answers True


class SolverHost(ABC):
    """The presenter asks (`post`) and looks (`news`); neither waits."""

    solve_cost_ns: int  # what a solution takes at present, as well as it is known

    @abstractmethod
    def post(self, request: SolveRequest) -> None:
        """Ask for a solution; a request that was not begun is forgotten."""

    @abstractmethod
    def news(self) -> SolverUpdate:
        """The newest complete solution and flat picture, and what failed."""

    @abstractmethod
    def do(self, task: Task) -> None:
        """Have something done between two steps, again and again until it answers True."""

    @abstractmethod
    def close(self) -> None:
        """Stop, and release what the solver holds. May be called twice."""


def taken_in(news: SolverUpdate, step: SolverUpdate) -> SolverUpdate:
    """The news updated by a step: its results, where it has any, and its failures."""
    return SolverUpdate(step.solution or news.solution, step.flat or news.flat, step.missing)


def total_ns(stage_ms: Mapping[str, float]) -> int:
    """Nanoseconds of the solver's stages together."""
    return round(sum(stage_ms.get(stage, 0.0) for stage in SOLVING_STAGES) * NS_PER_MS)


class SimulatedSolver(SolverHost):
    """Solves at once and hands over when the simulated clock has passed what the configured stages cost."""

    def __init__(self, parts: SolverParts, clock: Clock) -> None:
        self._parts, self._clock = parts, clock
        self._news = taken_in(SolverUpdate(), parts.step(FIRST_REQUEST))
        self._posted: tuple[int, SolveRequest] | None = None
        self._under_way: tuple[int, SolverUpdate] | None = None  # when it is complete
        self._idle_since_ns = clock.now_ns()
        self._tasks: list[Task] = []
        self._closed = False
        self.solve_cost_ns = total_ns(parts.simulated_stage_ms())

    def post(self, request: SolveRequest) -> None:
        self._advance()
        self._posted = self._clock.now_ns(), request
        self._advance()

    def news(self) -> SolverUpdate:
        self._advance()
        return self._news

    def do(self, task: Task) -> None:
        if not task(self._parts):
            self._tasks.append(task)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._parts.close()

    def _advance(self) -> None:
        """Everything that happened up to now, in order."""
        now_ns = self._clock.now_ns()
        while True:
            if self._under_way is not None:
                done_ns, step = self._under_way
                if done_ns > now_ns:
                    return
                self._news = taken_in(self._news, step)
                self._under_way, self._idle_since_ns = None, done_ns
            self._tasks = [task for task in self._tasks if not task(self._parts)]
            if self._posted is None:
                return
            (posted_ns, request), self._posted = self._posted, None
            begun_ns = max(posted_ns, self._idle_since_ns)
            step = self._timed(self._parts.step(request))
            self._under_way = begun_ns + self._cost_of(step), step

    def _timed(self, step: SolverUpdate) -> SolverUpdate:
        """With the stage times that the configuration says."""
        stages = dict(self._parts.simulated_stage_ms())
        self.solve_cost_ns = total_ns(stages)
        solving = {stage: stages.get(stage, 0.0) for stage in SOLVING_STAGES}
        solution, flat = step.solution, step.flat
        if solution is not None:
            solution = replace(solution, stage_ms=solving)
        if flat is not None:
            flat = replace(flat, stage_ms={"render": solving["render"]})
        return replace(step, solution=solution, flat=flat)

    @staticmethod
    def _cost_of(step: SolverUpdate) -> int:
        made = step.solution or step.flat
        return total_ns(made.stage_ms) if made is not None else 0
