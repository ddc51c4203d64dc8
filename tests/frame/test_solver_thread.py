"""Tests that exceptions, hangs and delays of the solver are reported and never stall the presenter."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import psutil
import pytest

from runtime.clock import NS_PER_S, MonotonicClock, SimulatedClock
from runtime.errors import ContextLost, FatalError, InputError
from runtime.frame.solver import SolverUpdate
from runtime.frame.solver_thread import ABANDON_S, ABANDONED_MAX, LATE_S, SolverThread
from runtime.records import Effort, SolveRequest
from runtime.report.pairs import PairPainter
from runtime.support.memory import keep_freed_memory
from runtime.support.untrusted_input import LIMITS
from tests.frame.fakes import STACK, FakeParts, aside, solution
from tests.waiting import eventually

PATIENCE_S = 20.0  # of a test with another thread, on a busy machine

Behaviour = Callable[[SolveRequest], SolverUpdate]


def wish(number: int) -> SolveRequest:
    return SolveRequest(number, aside(number / 1000), "predicted", 0.001, flat_wanted=False)


def solves(request: SolveRequest) -> SolverUpdate:
    made = solution(request.time_ns + 1, request.eyes_m, time_ns=request.time_ns, stage_ms={"inference": 20.0})
    return SolverUpdate(solution=made)


class Workshop:
    """Solver thread whose parts run the test's function at every step; every step is announced."""

    def __init__(self) -> None:
        self.clock = SimulatedClock(NS_PER_S)
        self.behave: Behaviour = solves
        self.refuse: Exception | None = None  # making parts raises this
        self.open = threading.Event()  # set: making parts returns
        self.open.set()
        self.made: queue.Queue[FakeParts] = queue.Queue()
        self.all: list[FakeParts] = []
        self.begun: queue.Queue[SolveRequest] = queue.Queue()
        self.gates: list[threading.Event] = []  # of steps that hang
        self.hung: list[threading.Thread] = []  # that are, or were, in such a step
        self.closed: queue.Queue[str] = queue.Queue()  # names of the threads that closed parts
        self.host = SolverThread(self._make, self.clock)

    def _make(self) -> FakeParts:
        assert self.open.wait(PATIENCE_S)
        if self.refuse is not None:
            raise self.refuse
        parts = _Announced(self._step, self.closed)
        self.all.append(parts)
        self.made.put(parts)
        return parts

    def _step(self, request: SolveRequest) -> SolverUpdate:
        if request.eyes_m is None:
            return SolverUpdate(flat=solution(1, None))
        self.begun.put(request)
        return self.behave(request)

    def hang(self, request: SolveRequest) -> SolverUpdate:
        """Step that returns solution 99 once its gate is opened."""
        gate = threading.Event()
        self.hung.append(threading.current_thread())
        self.gates.append(gate)
        assert gate.wait(PATIENCE_S)
        return SolverUpdate(solution=solution(99))

    def post(self, number: int) -> None:
        """Ask, and wait until the step has begun."""
        self.host.post(wish(number))
        while self.begun.get(timeout=PATIENCE_S).time_ns != number:
            pass

    def settle(self) -> None:
        """Wait until the current step is complete."""
        done = threading.Event()
        self.host.do(lambda parts: bool(done.set()) or True)
        assert done.wait(PATIENCE_S)

    def solve(self, number: int) -> None:
        self.post(number)
        self.settle()

    def pass_s(self, seconds: float) -> None:
        self.clock.advance_ns(round(seconds * NS_PER_S))

    def left(self) -> None:
        """Advance beyond the time limit of a hung step; wait for the new parts."""
        while not self.made.empty():
            self.made.get()
        self.pass_s(ABANDON_S + 0.1)
        self.host.news()
        self.made.get(timeout=PATIENCE_S)
        self.settle()  # its first step, the flat picture, is complete

    def close(self) -> None:
        self.open.set()
        for gate in self.gates:
            gate.set()
        self.host.close(PATIENCE_S)
        for gate in self.gates:
            gate.set()


class _Announced(FakeParts):
    """Records the thread that closes it."""

    def __init__(self, step: Behaviour, closed: queue.Queue[str]) -> None:
        super().__init__(step)
        self._announce = closed

    def close(self) -> None:
        super().close()
        self._announce.put(threading.current_thread().name)


@pytest.fixture
def shop() -> Iterator[Workshop]:
    made = Workshop()
    made.host.wait_ready()
    yield made
    made.close()


def test_measurements_and_the_first_picture_have_the_clocks_time(shop: Workshop) -> None:
    shop.settle()
    (parts,) = shop.all
    assert {*parts.costs_at_ns, parts.asked[0].time_ns} == {shop.clock.now_ns()}


def test_parts_live_on_one_thread_that_is_not_the_presenter_s(shop: Workshop) -> None:
    threads = []
    shop.behave = lambda request: (threads.append(threading.current_thread().name), solves(request))[1]
    shop.solve(1)
    shop.host.close(PATIENCE_S)
    shop.host.close(PATIENCE_S)
    assert [*threads, shop.closed.get(timeout=PATIENCE_S)] == ["solver-1", "solver-1"]
    assert shop.all[0].closed == 1
    assert not shop.hung


def test_what_can_t_be_made_is_raised_to_who_waits_for_it() -> None:
    def refuse() -> Any:
        raise InputError("model", "name", "is unknown")

    host = SolverThread(refuse, SimulatedClock(1))
    with pytest.raises(InputError, match="is unknown"):
        host.wait_ready()
    host.close(PATIENCE_S)


def test_waiting_for_a_solver_that_is_never_ready_can_be_ended() -> None:
    gate = threading.Event()
    made: Any = lambda: FakeParts(lambda _: SolverUpdate()) if gate.wait(PATIENCE_S) else None  # noqa: E731
    host = SolverThread(made, MonotonicClock())
    with pytest.raises(FatalError, match=r"not ready within 0\.2 s"):
        host.wait_ready(max_s=0.2)
    told: list[None] = []
    host.wait_ready(lambda: bool(told.append(None)))  # answers False
    assert len(told) == 1
    gate.set()
    host.close(PATIENCE_S)


def test_asking_and_looking_never_wait_for_a_step_that_does_not_return(shop: Workshop) -> None:
    shop.solve(1)
    shop.behave = shop.hang
    shop.post(2)
    for number in range(3, 500):  # these calls would hang, if they waited
        shop.host.post(wish(number))
        assert shop.host.news().solution.solved_for_ns == 1
        shop.host.do(lambda parts: True)


def test_of_the_wishes_that_came_meanwhile_only_the_newest_is_solved(shop: Workshop) -> None:
    shop.behave = shop.hang
    shop.post(1)
    shop.behave = solves
    for number in range(2, 10):
        shop.host.post(wish(number))
    shop.gates[0].set()
    assert shop.begun.get(timeout=PATIENCE_S).time_ns == 9
    shop.settle()
    assert shop.host.news().solution.solved_for_ns == 9
    assert shop.begun.empty()


def test_what_is_late_is_reported_in_milliseconds_while_the_last_solution_stays(shop: Workshop) -> None:
    shop.solve(1)
    shop.behave = shop.hang
    shop.post(2)
    shop.pass_s(2 * LATE_S)
    assert shop.host.news().missing == {}
    shop.pass_s(2.0)
    reason = shop.host.news().missing["model"]
    assert reason == f"the solver has not answered for {int((2 * LATE_S + 2.0) * 2) * 500} ms"
    assert shop.host.news().solution.solved_for_ns == 1


def test_one_late_step_is_no_fault_and_several_in_a_row_are(shop: Workshop) -> None:
    def slow(request: SolveRequest) -> SolverUpdate:
        shop.clock.advance_ns(round(1.5 * LATE_S * NS_PER_S))
        return solves(request)

    def missing(behave: Any, number: int) -> bool:
        shop.behave = behave
        shop.solve(number)
        return "model" in shop.host.news().missing

    steps = [slow, solves, slow, slow, slow, solves, solves, solves]
    late = [missing(behave, number) for number, behave in enumerate(steps, start=1)]
    assert late == [False, False, False, False, True, True, True, False]
    assert shop.host.news().missing == {}


def test_a_step_that_never_returns_is_abandoned_for_a_new_solver(shop: Workshop) -> None:
    shop.solve(1)
    shop.behave = shop.hang
    shop.post(2)
    shop.left()
    assert shop.host.restarts == 1
    assert [thread.is_alive() for thread in shop.hung] == [True]
    assert shop.host.news().solution.solved_for_ns == 1  # until there is another
    shop.behave = solves
    shop.solve(3)
    assert shop.host.news().solution.solved_for_ns == 3
    assert shop.host.news().missing == {}


def test_a_step_that_ends_while_it_is_timed_is_not_late(shop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    shop.pass_s(ABANDON_S)  # so that the clock's zero is longer ago than any step may take
    shop.behave = shop.hang
    shop.post(1)
    now_ns = shop.clock.now_ns
    presenter = threading.current_thread()

    def ends_the_step() -> int:
        if threading.current_thread() is presenter:
            shop.gates[0].set()
            shop.settle()
        return now_ns()

    with monkeypatch.context() as patch:
        patch.setattr(shop.clock, "now_ns", ends_the_step)
        assert shop.host.news().missing == {}
    assert shop.host.restarts == 0


def test_what_an_abandoned_step_makes_is_ignored(shop: Workshop) -> None:
    shop.behave = shop.hang
    shop.post(1)
    shop.left()
    shop.behave = solves
    shop.solve(2)
    shop.gates[0].set()
    assert shop.closed.get(timeout=PATIENCE_S) == "solver-1"
    assert shop.host.news().solution.solved_for_ns == 2


def test_a_solver_that_hangs_repeatedly_leaves_few_threads(shop: Workshop) -> None:
    shop.behave = shop.hang
    for number in range(1, ABANDONED_MAX + 1):
        shop.post(number)
        shop.left()
    shop.post(ABANDONED_MAX + 1)
    for _ in range(5):
        shop.pass_s(ABANDON_S + 0.1)
        assert "has not answered" in shop.host.news().missing["model"]
    assert shop.host.restarts == ABANDONED_MAX
    assert len(shop.all) == ABANDONED_MAX + 1
    shop.gates[-1].set()  # the last one returns after all, and serves again
    shop.behave = solves
    shop.settle()
    shop.solve(50)
    assert shop.host.news().solution.solved_for_ns == 50


def test_a_step_that_raises_is_reported_and_the_solver_remade(shop: Workshop) -> None:
    """`Solver.step` returns the missing parts; exceptions elsewhere must not end solving silently."""
    shop.solve(1)

    def fail(request: SolveRequest) -> SolverUpdate:
        raise RuntimeError("a bug in the budget")

    shop.behave = fail
    shop.post(2)
    assert shop.closed.get(timeout=PATIENCE_S) == "solver-1"
    assert "a bug in the budget" in shop.host.news().missing["model"]
    assert shop.host.news().solution.solved_for_ns == 1
    shop.behave = solves
    shop.left()
    shop.solve(3)
    assert shop.host.news().solution.solved_for_ns == 3
    assert shop.host.news().missing == {}


def test_memory_of_a_solver_that_ended_goes_back_to_the_system(shop: Workshop) -> None:
    keep_freed_memory()

    def fail(request: SolveRequest) -> SolverUpdate:
        blocks = [np.ones(1 << 20) for _ in range(48)]  # of 8 MiB, as pictures are; malloc keeps freed blocks
        held.append(blocks.pop())
        raise ContextLost("the panels have lost their OpenGL context")

    held: list[Any] = []
    shop.solve(1)
    shop.behave = fail
    before = psutil.Process().memory_info().rss
    shop.post(2)
    shop.closed.get(timeout=PATIENCE_S)
    assert eventually(lambda: psutil.Process().memory_info().rss - before < 64 << 20, within_s=PATIENCE_S)


def test_a_failure_to_remake_the_solver_is_reported_and_retried(shop: Workshop) -> None:
    shop.behave = shop.hang
    shop.post(1)
    shop.refuse = RuntimeError("no memory")
    shop.pass_s(ABANDON_S + 0.1)
    assert eventually(lambda: "no memory" in shop.host.news().missing.get("model", ""), within_s=PATIENCE_S)
    shop.refuse, shop.behave = None, solves
    shop.left()
    shop.solve(2)
    assert shop.host.news().missing == {}


def test_a_task_that_raises_is_done_and_nothing_else_is_lost(shop: Workshop, caplog: pytest.LogCaptureFixture) -> None:
    def fail(parts: Any) -> bool:
        raise RuntimeError("in a task")

    shop.host.do(fail)
    shop.settle()
    shop.solve(1)
    assert shop.host.news().solution.solved_for_ns == 1
    assert sum("a task of the solver failed" in record.getMessage() for record in caplog.records) == 1


def test_a_task_is_asked_again_after_every_step_until_it_is_done(shop: Workshop) -> None:
    asked = []
    shop.host.do(lambda parts: bool(asked.append(parts)) or len(asked) >= 3)
    for number in range(1, 6):
        shop.solve(number)
    assert asked == [shop.all[0]] * 3


def test_tasks_behind_a_hung_step_are_done_by_the_new_solver(shop: Workshop) -> None:
    shop.behave = shop.hang
    shop.post(1)
    done: queue.Queue[Any] = queue.Queue()
    shop.host.do(lambda parts: bool(done.put(parts)) or True)
    shop.left()
    assert done.get(timeout=PATIENCE_S) is shop.all[1]


def test_making_it_anew_may_take_as_long_as_at_the_start(shop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Content that took two minutes was once restarted every ten seconds, each time on one more thread."""

    def fail(request: SolveRequest) -> SolverUpdate:
        raise RuntimeError("its context was lost")

    shop.behave = fail
    shop.post(1)
    shop.closed.get(timeout=PATIENCE_S)
    shop.behave = solves
    shop.open.clear()
    for _ in range(12):
        shop.pass_s(ABANDON_S + 0.1)
        shop.host.news()
    assert "the solver has been restarting for 1" in shop.host.news().missing["model"]
    shop.open.set()
    shop.made.get(timeout=PATIENCE_S)
    shop.solve(2)
    assert (len(shop.all), shop.host.restarts, shop.host.news().solution.solved_for_ns) == (2, 0, 2)


def test_a_task_may_take_longer_than_a_step(shop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, gate = threading.Event(), threading.Event()
    shop.host.do(lambda parts: bool(begun.set()) or gate.wait(PATIENCE_S))
    assert begun.wait(PATIENCE_S)
    shop.pass_s(LIMITS.load_s - 1.0)
    shop.host.news()
    assert shop.host.restarts == 0
    shop.pass_s(2.0)
    shop.host.news()
    assert shop.host.restarts == 1
    gate.set()


def test_parts_that_were_abandoned_in_a_task_time_nothing_afterwards(shop: Workshop) -> None:
    """By then, the run's content and model are the new solver's, on another thread with another OpenGL context."""
    begun, gate, timed = threading.Event(), threading.Event(), []
    parts: Any = shop.all[0]
    shop.host.do(lambda parts: bool(begun.set()) or gate.wait(PATIENCE_S))
    assert begun.wait(PATIENCE_S)
    parts.first_costs = lambda *, time_ns: timed.append(threading.current_thread().name) or {1: {"finish": 1e3}}
    shop.pass_s(LIMITS.load_s)
    shop.left()
    gate.set()
    assert shop.closed.get(timeout=PATIENCE_S) == "solver-1"
    assert timed == []
    assert shop.host.costs.ms(Effort()) == 0.0


def test_where_no_thread_can_be_started_what_hangs_is_abandoned_later(
    shop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the limit of tasks the next fault ended the display."""

    def refuse(*_: Any) -> None:
        raise RuntimeError("can't start new thread")  # as the interpreter does

    shop.solve(1)
    shop.behave = shop.hang
    shop.post(2)
    with monkeypatch.context() as exhausted:
        exhausted.setattr(threading, "_start_new_thread", refuse)
        shop.pass_s(ABANDON_S + 0.1)
        assert "has not answered" in shop.host.news().missing["model"]
        assert (shop.host.restarts, shop.host.news().solution.solved_for_ns) == (0, 1)
    shop.left()
    shop.behave = solves
    shop.solve(3)
    assert shop.host.news().solution.solved_for_ns == 3


def test_a_stop_ends_a_step_between_two_drawings(shop: Workshop) -> None:
    drawn = 0

    def draws(request: SolveRequest) -> SolverUpdate:
        nonlocal drawn
        with PairPainter("demo", STACK) as painter:
            while drawn < 3000:
                painter.image(aside(0.0)[0], width_px=160, height_px=90)
                drawn += 1
        return solves(request)

    shop.behave = draws
    shop.post(1)
    assert eventually(lambda: drawn > 0)
    shop.host.close(PATIENCE_S)
    assert [parts.closed for parts in shop.all] == [1]
    assert drawn < 3000


def test_after_a_change_of_the_model_its_own_rasters_are_timed(shop: Workshop) -> None:
    shop.solve(1)
    assert set(shop.host.costs.stages) == {1}
    parts: Any = shop.all[0]
    parts.first_costs = lambda *, time_ns: {1: {"finish": 40.0}, 2: {"finish": 10.0}}
    shop.host.do(lambda _: True)
    shop.solve(2)
    assert set(shop.host.costs.stages) == {1, 2}
    assert shop.host.costs.ms(Effort(2, 0)) <= 10.0
