"""Host that runs the solver in a separate process (`daemon.solver_worker`).

A solver that crashes, hangs or takes too much memory is replaced. Meanwhile, the panels keep the last solution.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.frame.effort import Costs
from runtime.frame.messages import (
    Answer,
    Busy,
    Done,
    Draw,
    Drawn,
    Facts,
    Idle,
    Live,
    Order,
    Progress,
    Slot,
    SolverUpdate,
    Stepped,
)
from runtime.frame.solver_host import SolverHost, taken_in
from runtime.model.buffers import LayerSlots
from runtime.optics.stack import PanelStack
from runtime.records import Solution, SolveRequest
from runtime.support.channel import shared_memory
from runtime.support.process import Began, Ended, Role, Worker

LATE_S = 0.5  # a longer step is late; a single step of more than twice this length is a fault
CHANGE_LATE_S = 10.0  # an order, or the first solution of another scene or model, that takes longer is a fault
LATE_STEPS = 3  # this many late steps in a row are a fault; this many steps in a row on time clear it
ANSWER_STEP_MS = 500  # the reported time without an answer is rounded down to a multiple of this
REPLACED = "the solver was restarted with the old settings because it had ended or hung"


@dataclass(frozen=True, slots=True)
class Known:
    """Facts and costs for starting the next solver. Replaced as a whole."""

    facts: Facts | None = None  # None until the first solver is ready
    first: dict[int, dict[str, float]] = field(default_factory=dict)  # costs of the present model
    next_number: int = 1  # number of the next solution


class SolverProcess(SolverHost):
    """Runs a solver in parallel with the presenter, in its own process."""

    def __init__(
        self,
        role: Role,
        stack: PanelStack,
        setup: Callable[[Known], Any],
        clock: Clock,
        *,
        contexts_lost: Callable[[], int] = lambda: 0,
        files: Sequence[int] = (),
    ) -> None:
        """Start a solver, whose `setup` is read on another thread, and which inherits file descriptors under the same
        numbers. The clock must be the machine's. The solver is replaced whenever the number of GL contexts lost by the
        panels changes.
        """
        super().__init__()
        self._clock, self._setup, self._contexts_lost = clock, setup, contexts_lost
        self._late_ns = round(LATE_S * NS_PER_S)
        self._memory = shared_memory("layers", LayerSlots.bytes_of(stack))
        self._slots = LayerSlots(self._memory, stack)
        self._known = Known()
        self._costs, self._live = Costs({}), Live()
        self._news = SolverUpdate()
        self._unsent: list[Order] = []
        self._drawing: set[int] = set()  # numbers of the `Draw` orders without an answer
        self._busy: Busy | None = None
        self._since_ns = clock.now_ns()  # when the solver ended, or began to work
        self._took_ns: deque[int] = deque(maxlen=LATE_STEPS)  # durations of the latest steps
        self._is_late = False
        self._is_new = False  # True until the first solution after a change of the scene or model
        self._lost_before = 0
        self._worker = Worker(role, lambda: (self._memory, self._setup(self._known)), files=(self._memory, *files))

    def wait_ready(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Wait until the first solver is ready or `go_on` returns False. Raises the error that prevented it."""
        self._worker.wait_ready(go_on)
        self._lost_before = self._contexts_lost()
        self._take_in()

    @property
    def is_known(self) -> bool:
        """True once the first solver has been ready."""
        return self._known.facts is not None

    @property
    def restarts(self) -> int:  # type: ignore[override]
        return self._worker.restarts

    @property
    def descriptor(self) -> int | None:  # type: ignore[override]
        return self._worker.descriptor

    @property
    def costs(self) -> Costs:
        return self._costs

    @property
    def facts(self) -> Facts:
        assert self._known.facts is not None
        return self._known.facts

    @property
    def live(self) -> Live:
        return self._live

    def free_ns(self, now_ns: int) -> int:
        busy = self._busy
        if busy is None or busy.effort is None:
            return now_ns
        return max(busy.since_ns + round(self._costs.ms(busy.effort) * NS_PER_MS), now_ns)

    def post(self, request: SolveRequest) -> None:
        self._worker.send(request)

    def news(self) -> SolverUpdate:
        if self._contexts_lost() != self._lost_before:
            self._lost_before = self._contexts_lost()
            self._worker.restart("was ended because the panels have lost their OpenGL context")
        self._take_in()
        late = self._late_reason()
        return replace(self._news, missing={**self._news.missing, "model": late}) if late else self._news

    def restart(self, reason: str) -> None:
        self._worker.restart(reason)

    def status(self) -> list[dict[str, Any]]:
        return [self._worker.status()]

    def close(self) -> None:
        if self._memory >= 0:
            self._worker.close()
            os.close(self._memory)
            self._memory = -1

    def _dispatch(self, order: Order) -> None:
        if isinstance(order, Draw):
            self._drawing.add(order.number)
        if self._unsent or not self._worker.send(order):
            self._unsent.append(order)

    def _take_in(self) -> None:
        for message in self._worker.receive():
            match message:
                case Began():
                    self._busy = None
                case Ended():
                    self._ended()
                case Busy():
                    self._busy, self._since_ns = message, message.since_ns
                case Stepped():
                    self._stepped(message)
                case Idle():
                    self._busy, self._costs, self._live = None, message.costs, message.live
                    first = {by: dict(stages) for by, stages in message.first.items()}
                    self._known = replace(self._known, facts=message.facts, first=first)
                case Progress() | Done() | Drawn():
                    self._take_answer(message)
        while self._unsent and self._worker.send(self._unsent[0]):
            self._unsent.pop(0)

    def _take_answer(self, answer: Answer) -> None:
        if isinstance(answer, Done) and answer.facts is not None:
            self._is_new = True
            self._known = replace(self._known, facts=answer.facts)
        self._drawing.discard(answer.number)
        self._answered(answer)

    def _stepped(self, message: Stepped) -> None:
        update = message.update
        solution = self._received(update.solution, message.solution)
        flat = self._received(update.flat, message.flat)
        self._news = taken_in(self._news, SolverUpdate(solution, flat, update.missing))
        self._costs, self._live, self._busy = message.costs, message.live, None
        if self._known.facts is not None:  # they come after the first step
            self._known = replace(self._known, facts=replace(self._known.facts, info=message.info))
        if message.took_ns and not self._is_new:
            self._took_ns.append(message.took_ns)
        self._is_new = self._is_new and update.solution is None

    def _received(self, solution: Solution | None, slot: Slot | None) -> Solution | None:
        if solution is None or slot is None:
            return None
        self._known = replace(self._known, next_number=max(self._known.next_number, solution.number + 1))
        return replace(solution, layers=self._slots.view(slot.index, slot.shape))

    def _ended(self) -> None:
        """Forget the solver's work. Orders that it was carrying out are not carried out again."""
        self._slots.reclaim()
        self._busy, self._since_ns = None, self._clock.now_ns()
        self._took_ns.clear()
        self._is_late = False
        unsent = {order.number for order in self._unsent}
        for number in [number for number in self._waiting if number not in unsent]:
            self._take_answer(Drawn(number, None) if number in self._drawing else Done(number, REPLACED))

    def _late_reason(self) -> str:
        """Return the reason why the solver is unavailable or late, or "" if it works on time."""
        now_ns = self._clock.now_ns()
        if fault := self._worker.fault:
            gone_ms = _rounded_ms(now_ns - self._since_ns)
            return f"{fault} (for {gone_ms} ms)" if gone_ms else fault
        busy = self._busy
        busy_ns = now_ns - busy.since_ns if busy is not None else 0
        is_slow = self._is_new or (busy is not None and busy.effort is None)
        if busy_ns > (CHANGE_LATE_S * NS_PER_S if is_slow else 2 * self._late_ns):
            return f"the solver has not answered for {_rounded_ms(busy_ns)} ms"
        steps = tuple(self._took_ns)
        late = sum(took_ns > self._late_ns for took_ns in steps)
        self._is_late = late == LATE_STEPS or (self._is_late and late > 0)
        took_ms, limit_ms = max(steps, default=0) / NS_PER_MS, self._late_ns / NS_PER_MS
        return f"solutions take {took_ms:.0f} ms, more than the limit of {limit_ms:.0f} ms" if self._is_late else ""


def _rounded_ms(duration_ns: int) -> int:
    return duration_ns // NS_PER_MS // ANSWER_STEP_MS * ANSWER_STEP_MS
