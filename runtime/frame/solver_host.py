"""Interface between the presenter and a solver, and an implementation for a simulated clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from runtime.clock import NS_PER_MS, Clock
from runtime.frame.effort import Costs
from runtime.frame.messages import Answer, Facts, Live, Order, Progress, SolverUpdate
from runtime.records import SolveRequest


def first_request(now_ns: int) -> SolveRequest:
    """Return the request for the flat picture that precedes the first refresh."""
    return SolveRequest(now_ns, None, "none", 0.0, flat_wanted=True)


class SolverParts(Protocol):
    """A solver with its scene, its model and its GL context. For use on one thread."""

    def step(self, request: SolveRequest) -> SolverUpdate:
        """Carry out one request and return its results."""

    def turn(self, orders: Sequence[Order]) -> list[Answer]:
        """Carry out orders between two steps, and return the answers that are ready."""

    @property
    def facts(self) -> Facts:
        """Scene, model and device in use."""

    def live(self, time_ns: int) -> Live:
        """Return what changes by itself."""

    def simulated_costs(self) -> Costs:
        """Return the solution costs that apply on a simulated clock with the current settings."""

    def first_costs(self, *, time_ns: int) -> Mapping[int, Mapping[str, float]]:
        """Return solution times in ms, by reduction and stage, measured first and after changes of the model."""

    def close(self) -> None:
        """Release all resources."""


Then = Callable[[Answer], None]


class SolverHost(ABC):
    """Base class for hosts, which run a solver on the presenter's behalf, and on its thread only. The
    presenter posts requests, sends orders and reads results. None of these waits for the solver.
    """

    restarts = 0  # how many solvers have been replaced
    descriptor: int | None = None  # file descriptor that is readable when there may be news; None: unknown

    def __init__(self) -> None:
        self._sent = 0
        self._waiting: dict[int, Then] = {}  # orders without a last answer

    @property
    @abstractmethod
    def costs(self) -> Costs:
        """Current solution costs."""

    @property
    @abstractmethod
    def facts(self) -> Facts:
        """Scene, model and device in use."""

    @property
    @abstractmethod
    def live(self) -> Live:
        """Values that change by themselves."""

    @abstractmethod
    def free_ns(self, now_ns: int) -> int:
        """Return when the solver is expected to begin a request that is posted at `now_ns`."""

    @abstractmethod
    def post(self, request: SolveRequest) -> None:
        """Request a solution, replacing any earlier request that has not been started."""

    @abstractmethod
    def news(self) -> SolverUpdate:
        """Pass on all answers, and return the latest solution and flat picture, and the failed parts."""

    def send(self, order: Order, then: Then = lambda answer: None) -> int:
        """Send an order without a number, and return its number. `news` calls `then` with each answer."""
        self._sent += 1
        self._waiting[self._sent] = then
        self._dispatch(replace(order, number=self._sent))
        return self._sent

    def restart(self, reason: str) -> None:  # noqa: B027 - a solver in this process cannot be ended
        """Replace the solver, if it has a process. A reason is `was ended because it took too long`."""

    def status(self) -> list[dict[str, Any]]:
        """Return the solver's process and its resources, for the status. Empty if it is this process."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Stop the solver and release its resources. May be called more than once."""

    @abstractmethod
    def _dispatch(self, order: Order) -> None:
        """Pass an order on to the solver."""

    def _answered(self, answer: Answer) -> None:
        waiting = self._waiting
        then = waiting.get(answer.number) if isinstance(answer, Progress) else waiting.pop(answer.number, None)
        if then is not None:
            then(answer)


def taken_in(news: SolverUpdate, step: SolverUpdate) -> SolverUpdate:
    """Return `news` updated with a step's results and with the parts that failed during the step."""
    return SolverUpdate(step.solution or news.solution, step.flat or news.flat, step.missing)


class SimulatedSolver(SolverHost):
    """Runs a solver on a simulated clock. Computes each request immediately, but publishes the result
    only once the simulated clock has advanced by the solution's configured cost.
    """

    def __init__(self, parts: SolverParts, clock: Clock) -> None:
        super().__init__()
        self.parts, self._clock = parts, clock
        self._news = taken_in(SolverUpdate(), parts.step(first_request(clock.now_ns())))
        self._posted: tuple[int, SolveRequest] | None = None
        self._under_way: tuple[int, SolverUpdate] | None = None  # completion time in ns, and result
        self._idle_since_ns = clock.now_ns()
        self._closed = False

    @property
    def costs(self) -> Costs:
        return self.parts.simulated_costs()

    def free_ns(self, now_ns: int) -> int:
        self._advance()
        return now_ns if self._under_way is None else self._under_way[0]

    def post(self, request: SolveRequest) -> None:
        self._advance()
        self._posted = self._clock.now_ns(), request
        self._advance()

    def news(self) -> SolverUpdate:
        self._advance()
        return self._news

    @property
    def facts(self) -> Facts:
        return self.parts.facts

    @property
    def live(self) -> Live:
        return self.parts.live(self._clock.now_ns())

    def _dispatch(self, order: Order) -> None:
        self._turn(order)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.parts.close()

    def look(self) -> None:
        """Pass on answers to orders that take real time, such as loading."""
        self._turn()

    def _turn(self, *orders: Order) -> None:
        for answer in self.parts.turn(orders):
            self._answered(answer)

    def _advance(self) -> None:
        """Publish results, carry out orders and start requests, in order, up to the current time."""
        now_ns = self._clock.now_ns()
        while True:
            if self._under_way is not None:
                done_ns, step = self._under_way
                if done_ns > now_ns:
                    return
                self._news = taken_in(self._news, step)
                self._under_way, self._idle_since_ns = None, done_ns
            self._turn()
            if self._posted is None:
                return
            (posted_ns, request), self._posted = self._posted, None
            begun_ns = max(posted_ns, self._idle_since_ns)
            step, cost_ns = self._timed(self.parts.step(request))
            self._under_way = begun_ns + cost_ns, step

    def _timed(self, step: SolverUpdate) -> tuple[SolverUpdate, int]:
        """Return a step's result with the configured stage times filled in, and its cost in nanoseconds."""
        solution, flat, costs = step.solution, step.flat, self.costs
        if solution is not None:
            costs = costs.for_people(len(solution.people))
        if solution is not None and solution.effort is not None:
            effort = solution.effort
            stages = dict(costs.stages[effort.reduction])
            stages["step"] *= effort.steps - (effort.continued_from or 0)
            if effort.continued_from is not None:
                stages |= dict.fromkeys(("render", "prepare", "inference"), 0.0)
            return replace(step, solution=replace(solution, stage_ms=stages)), round(costs.ms(effort) * NS_PER_MS)
        if flat is not None:
            render_ms = costs.stages[1]["render"]
            return replace(step, flat=replace(flat, stage_ms={"render": render_ms})), round(render_ms * NS_PER_MS)
        return step, 0
