"""Tests the solver in simulated time: results appear after the configured cost, the newest request wins."""

from __future__ import annotations

from dataclasses import replace

import pytest

from runtime.clock import NS_PER_MS, SimulatedClock
from runtime.frame.messages import Answer, Done, Progress, Skip, SolverUpdate
from runtime.frame.solver_host import SimulatedSolver
from runtime.records import Effort, SolveRequest
from tests.frame.fakes import FakeParts, aside, solution

COST_MS = {"render": 8.0, "prepare": 4.0, "inference": 3.0, "finish": 8.0, "sensor": 100.0, "present": 100.0}
SUM_NS = 23 * NS_PER_MS


def wish(number: int = 0) -> SolveRequest:
    """Another one for each number."""
    return SolveRequest(number, aside(number / 1000), "predicted", 0.001, flat_wanted=False)


class Solving:
    """Solves every request, and draws the flat picture without a viewer."""

    def __init__(self) -> None:
        self.number = 0

    def __call__(self, request: SolveRequest) -> SolverUpdate:
        self.number += 1
        if request.eyes_m is None:
            return SolverUpdate(flat=solution(self.number, None, time_ns=request.time_ns))
        return SolverUpdate(solution=solution(self.number, request.eyes_m, time_ns=request.time_ns))


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(1_000_000)


@pytest.fixture
def parts() -> FakeParts:
    return FakeParts(Solving(), COST_MS)


@pytest.fixture
def host(parts: FakeParts, clock: SimulatedClock) -> SimulatedSolver:
    return SimulatedSolver(parts, clock)


def test_a_solution_is_handed_over_exactly_when_its_cost_has_passed(
    host: SimulatedSolver, clock: SimulatedClock
) -> None:
    host.post(wish(5))
    clock.advance_ns(SUM_NS - 1)
    assert host.news().solution is None
    clock.advance_ns(1)
    made = host.news().solution
    assert made.solved_for_ns == 5
    assert made.stage_ms == {"render": 8.0, "prepare": 4.0, "inference": 3.0, "finish": 8.0, "step": 0.0}


@pytest.mark.parametrize(
    ("effort", "people", "stage_ms", "cost_ms"),
    [
        (Effort(1, 3), (1,), [8, 4, 3, 8, 30], 53),
        (Effort(1, 3), (1, 2), [16, 8, 6, 8, 60], 98),
        (Effort(1, 5, continued_from=3), (1,), [0, 0, 0, 8, 20], 28),
    ],
)
def test_a_solution_s_stages_take_as_long_as_configured(
    host: SimulatedSolver, parts: FakeParts, clock: SimulatedClock,
    effort: Effort, people: tuple[int, ...], stage_ms: list[float], cost_ms: int,
) -> None:  # fmt: skip
    parts.stage_ms = {**COST_MS, "step": 10.0}
    parts.behave = lambda request: SolverUpdate(solution=solution(3, effort=effort, people=people))
    host.post(wish(5))
    clock.advance_ns(cost_ms * NS_PER_MS - 1)
    assert host.news().solution is None
    clock.advance_ns(1)
    assert [*host.news().solution.stage_ms.values()] == stage_ms


def test_a_host_is_closed_once(host: SimulatedSolver, parts: FakeParts) -> None:
    host.close()
    host.close()
    assert parts.closed == 1


def test_a_busy_solver_says_when_it_will_begin_another_request(host: SimulatedSolver, clock: SimulatedClock) -> None:
    now_ns = clock.now_ns()
    assert host.free_ns(now_ns) == now_ns
    host.post(wish(1))
    assert host.free_ns(now_ns) == now_ns + SUM_NS
    clock.advance_ns(SUM_NS + 1)
    assert host.free_ns(clock.now_ns()) == clock.now_ns()


def test_a_busy_solver_takes_the_newest_request_next(
    host: SimulatedSolver, parts: FakeParts, clock: SimulatedClock
) -> None:
    begun_ns = clock.now_ns()
    host.post(wish(1))
    for number in (2, 3, 4):
        clock.advance_ns(5 * NS_PER_MS)
        host.post(wish(number))
    clock.sleep_until_ns(begun_ns + 2 * SUM_NS - 1)
    assert host.news().solution.solved_for_ns == 1
    clock.advance_ns(1)
    assert host.news().solution.solved_for_ns == 4
    clock.advance_ns(10 * SUM_NS)
    assert [request.time_ns for request in parts.asked] == [begun_ns, 1, 4]  # skipped requests are never solved
    host.post(wish(5))
    host.post(wish(6))
    clock.advance_ns(SUM_NS)
    host.post(wish(7))  # the solver has begun the one before, although nobody has looked
    assert [request.time_ns for request in parts.asked][3:] == [5, 6]


def test_nothing_depends_on_when_it_is_looked_at(clock: SimulatedClock) -> None:
    """Looking more often passes no time and changes no result."""

    def run(looks: int) -> list[tuple[int, int]]:
        time = SimulatedClock()
        solver = SimulatedSolver(FakeParts(Solving(), COST_MS), time)
        told = []
        for number in range(40):
            solver.post(wish(number))
            for _ in range(looks):
                solver.news()
            time.advance_ns(16 * NS_PER_MS)
            made = solver.news().solution
            told.append((0, 0) if made is None else (made.number, made.solved_for_ns))
        return told

    assert run(0) == run(1) == run(7)


def test_a_flat_picture_costs_its_drawing_alone(host: SimulatedSolver, clock: SimulatedClock) -> None:
    first = host.news().flat
    host.post(replace(wish(7), eyes_m=None))
    clock.advance_ns(8 * NS_PER_MS - 1)
    assert host.news().flat is first
    clock.advance_ns(1)
    assert host.news().flat.solved_for_ns == 7


def test_where_there_is_nothing_to_do_no_time_passes(clock: SimulatedClock) -> None:
    parts = FakeParts(lambda request: SolverUpdate(), COST_MS)
    host = SimulatedSolver(parts, clock)
    host.post(wish(1))
    host.post(wish(2))
    assert [request.time_ns for request in parts.asked] == [clock.now_ns(), 1, 2]
    assert host.news().solution is None


def test_what_failed_is_told_and_the_last_solution_stays(
    parts: FakeParts, host: SimulatedSolver, clock: SimulatedClock
) -> None:
    host.post(wish(1))
    clock.advance_ns(SUM_NS)
    good = host.news().solution
    parts.behave = lambda request: SolverUpdate(missing={"model": "out of memory"})
    host.post(wish(2))
    assert host.news().missing == {"model": "out of memory"}
    assert host.news().solution is good
    parts.behave = Solving()
    host.post(wish(3))
    clock.advance_ns(SUM_NS)
    assert host.news().missing == {}


def test_an_order_is_carried_out_at_once_and_its_answer_passed_on(host: SimulatedSolver, parts: FakeParts) -> None:
    answers: list[Answer] = []
    parts.answer = lambda order: Done(order.number, "refused")
    number = host.send(Skip(5), answers.append)
    assert parts.orders == [Skip(5, number)] and answers == [Done(number, "refused")]


def test_an_order_that_takes_longer_is_answered_later_and_once(host: SimulatedSolver, parts: FakeParts) -> None:
    answers: list[Answer] = []
    number = host.send(Skip(5), answers.append)
    host.post(wish(1))
    assert answers == []
    parts.late = [Progress(number, "reading"), Done(number), Done(number)]
    host.look()
    assert answers == [Progress(number, "reading"), Done(number)]


def test_a_cost_that_changes_is_told(host: SimulatedSolver, parts: FakeParts, clock: SimulatedClock) -> None:
    """Another model was chosen."""
    parts.stage_ms = {"render": 2.0, "inference": 1.0}
    host.post(wish(1))
    clock.advance_ns(3 * NS_PER_MS)
    assert host.news().solution is not None
    assert host.costs.ms(Effort()) == 3.0
