"""Tests the host of a solver's process: what it passes on, what counts as late, and what a solver's end leaves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS, SimulatedClock
from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.frame import solver_process
from runtime.frame.effort import Costs
from runtime.frame.messages import (
    Answer,
    Busy,
    Done,
    Draw,
    Drawn,
    Idle,
    Live,
    Progress,
    Skip,
    Slot,
    SolverUpdate,
    Stepped,
)
from runtime.frame.solver_host import first_request
from runtime.frame.solver_process import REPLACED, Known, SolverProcess
from runtime.model.buffers import LayerSlots
from runtime.records import Effort
from runtime.support.process import Began, Ended, Role
from tests.frame.fakes import STACK, facts, solution

COSTS = Costs({1: {"render": 30.0}, 2: {"render": 10.0}})


class FakeWorker:
    """A process whose messages are a test's."""

    def __init__(self, role: Role, arguments: Any, *, files: tuple[int, ...]) -> None:
        self.arguments, self.files = arguments, files
        self.messages: list[Any] = []
        self.sent: list[Any] = []
        self.ended: list[str] = []
        self.fault, self.takes, self.closed = "", True, 0

    def wait_ready(self, go_on: Any) -> None:
        """Do not wait."""

    def receive(self) -> list[Any]:
        messages, self.messages = self.messages, []
        return messages

    def send(self, message: Any) -> bool:
        if self.takes:
            self.sent.append(message)
        return self.takes

    def restart(self, reason: str) -> None:
        self.ended.append(reason)

    def status(self) -> dict[str, Any]:
        return {"role": "solver"}

    def close(self) -> None:
        self.closed += 1


class Hosting:
    """A host whose solver has begun to work."""

    def __init__(self) -> None:
        self.clock, self.lost, self.known = SimulatedClock(10**9), 3, Known()
        self.host = SolverProcess(
            Role("solver", print), STACK, self._setup, self.clock, contexts_lost=lambda: self.lost, files=(77,)
        )
        self.worker: Any = self.host._worker
        self.slots = LayerSlots(os.dup(self.worker.files[0]), STACK)  # the solver's
        assert not self.host.is_known and self.worker.files[1:] == (77,)
        self.worker.messages = [Began(1), Idle(COSTS, Live("loads"), facts(Settings()), COSTS.stages)]
        self.host.wait_ready()
        assert self.host.is_known and (self.host.costs, self.host.live) == (COSTS, Live("loads"))

    def _setup(self, known: Known) -> None:
        self.known = known

    def next_solver(self) -> Known:
        """What the next process is started with."""
        self.worker.arguments()
        return self.known

    def busy(self, effort: Effort | None = None) -> None:
        self.worker.messages.append(Busy(self.clock.now_ns(), effort))

    def stepped(self, number: int | None = None, *, took_ms: float = 20.0, flat: int | None = None) -> None:
        """The solver has worked for so long, and perhaps made a solution or a flat picture."""
        made = [None if n is None else solution(n, *([None] * (n == flat))) for n in (number, flat)]
        places = [None if one is None else self.slots.hand_over(one.layers) for one in made]
        places = [None if place is None else Slot(*place) for place in places]
        update, took_ns = SolverUpdate(*made, {"content": "busy"}), round(took_ms * NS_PER_MS)
        self.worker.messages.append(Stepped(update, *places, took_ns, COSTS, Live(), ContentInfo("next")))

    def late(self, *, after_ms: float = 0.0) -> str:
        self.clock.advance_ns(round(after_ms * NS_PER_MS))
        return self.host.news().missing.get("model", "")


@pytest.fixture
def hosting(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hosting]:
    monkeypatch.setattr(solver_process, "Worker", FakeWorker)
    made = Hosting()
    yield made
    made.host.close()
    made.host.close()
    assert made.worker.closed == 1


def test_solutions_arrive_in_shared_memory_and_number_the_next_solver_s(hosting: Hosting) -> None:
    hosting.stepped(4, flat=6)
    hosting.stepped(5)
    news = hosting.host.news()
    assert news.solution is not None and news.flat is not None
    assert (news.solution.number, news.flat.number, news.missing) == (5, 6, {"content": "busy"})
    assert np.unique(news.solution.layers) == [5] and np.unique(news.flat.layers) == [6]
    known = hosting.next_solver()
    assert (known.next_number, known.first) == (7, COSTS.stages)
    assert known.facts is not None and known.facts.info.name == hosting.host.facts.info.name == "next"


def test_a_busy_solver_is_free_once_its_solution_s_cost_has_passed(hosting: Hosting) -> None:
    now_ns = hosting.clock.now_ns()
    for effort, free_ms in ((None, 0), (Effort(1), 30), (Effort(2), 10)):
        hosting.busy(effort)
        hosting.host.news()
        assert hosting.host.free_ns(now_ns) == now_ns + free_ms * NS_PER_MS
        assert hosting.host.free_ns(now_ns + 40 * NS_PER_MS) == now_ns + 40 * NS_PER_MS
    for ends in (hosting.stepped, lambda: hosting.worker.messages.append(Began(2))):
        hosting.busy(Effort(1))
        ends()
        hosting.host.news()
        assert hosting.host.free_ns(now_ns) == now_ns


@pytest.mark.parametrize(
    ("took_ms", "late_ms"),
    [
        ((501, 501), None),
        ((501, 500, 501), None),
        ((501, 700, 501), 700),
        ((501, 700, 501, 20, 600), 600),
        ((501, 700, 501, 20, 20, 500), None),  # three steps on time
        ((501, 700, 501, 20, 20, 500, 501, 501), None),
        ((501, 700, 0, 501), 700),  # the first request's step has no time
    ],
)
def test_three_late_steps_are_a_fault_and_three_on_time_end_it(
    hosting: Hosting, took_ms: tuple[int, ...], late_ms: int | None
) -> None:
    late = ""
    for step_ms in took_ms:
        hosting.stepped(5, took_ms=step_ms)
        late = hosting.late()
    assert late == ("" if late_ms is None else f"solutions take {late_ms} ms, more than the limit of 500 ms")


@pytest.mark.parametrize(("effort", "most_ms"), [(Effort(), 1000), (None, 10_000)], ids=["solution", "order"])
def test_a_solver_that_never_answers_is_a_fault(hosting: Hosting, effort: Effort | None, most_ms: int) -> None:
    hosting.busy(effort)
    assert hosting.late(after_ms=most_ms) == ""
    assert hosting.late(after_ms=1) == f"the solver has not answered for {most_ms} ms"
    assert hosting.late(after_ms=498) == f"the solver has not answered for {most_ms} ms"
    assert hosting.late(after_ms=1) == f"the solver has not answered for {most_ms + 500} ms"
    hosting.stepped(5)
    assert hosting.late() == ""


def test_the_first_solution_of_another_scene_may_take_long(hosting: Hosting) -> None:
    hosting.worker.messages.append(Done(9, facts=facts(Settings(), scene=2)))
    for number, may_be_late in ((None, False), (None, False), (7, False), (8, True)):
        hosting.busy(Effort())
        assert (hosting.late(after_ms=1001) != "") == may_be_late
        for _ in range(3):
            hosting.stepped(number, took_ms=900)
    assert hosting.host.facts.scene == 2 and hosting.late() == "solutions take 900 ms, more than the limit of 500 ms"


def test_a_solver_that_ended_is_named_with_the_time_it_is_gone(hosting: Hosting) -> None:
    hosting.busy(Effort())
    for _ in range(3):
        hosting.stepped(5, took_ms=900)
    assert hosting.late() != ""
    hosting.worker.messages.append(Ended("it crashed"))
    hosting.worker.fault = "the solver crashed"
    assert hosting.late() == hosting.late(after_ms=499) == "the solver crashed"
    assert hosting.late(after_ms=1) == hosting.late(after_ms=499) == "the solver crashed (for 500 ms)"
    assert hosting.late(after_ms=1) == "the solver crashed (for 1000 ms)"
    hosting.worker.fault = ""
    assert hosting.late() == "", "the next one's steps are counted anew"


def test_orders_wait_in_line_and_those_under_way_end_with_their_solver(hosting: Hosting) -> None:
    answers: list[Answer] = []
    hosting.host.post(first_request(5))
    skip, draw = (hosting.host.send(order, answers.append) for order in (Skip(1), Draw({}, None, 40.0)))
    hosting.worker.takes = False
    waiting = hosting.host.send(Skip(2), answers.append)
    hosting.worker.takes = True
    last = hosting.host.send(Skip(3), answers.append)
    request, *orders = hosting.worker.sent
    assert request == first_request(5) and [order.number for order in orders] == [skip, draw], (
        "in order, after the one that waits"
    )
    hosting.worker.messages = [Progress(skip, "loading"), Ended("it crashed")]
    hosting.worker.takes = False
    hosting.host.news()
    assert answers == [Progress(skip, "loading"), Done(skip, REPLACED), Drawn(draw, None)]
    hosting.worker.takes = True
    hosting.host.news()
    assert [order.number for order in hosting.worker.sent[1:]] == [skip, draw, waiting, last]
    hosting.worker.messages = [Done(waiting), Done(last)]
    hosting.host.news()
    assert answers[3:] == [Done(waiting), Done(last)]


def test_a_lost_context_of_the_panels_replaces_the_solver_once(hosting: Hosting) -> None:
    hosting.host.news()
    assert hosting.worker.ended == []
    hosting.lost += 1
    for _ in range(2):
        hosting.host.news()
    hosting.host.restart("was ended because it took too long")
    assert hosting.host.status() == [{"role": "solver"}]
    assert hosting.worker.ended == [
        "was ended because the panels have lost their OpenGL context", "was ended because it took too long",
    ]  # fmt: skip


def test_an_ended_solver_s_slots_are_free_except_those_in_use(hosting: Hosting) -> None:
    hosting.stepped(1)
    held = hosting.host.news().solution
    for _ in range(15):  # handed over, but never received
        assert hosting.slots.hand_over(solution(9).layers) is not None
    assert not hosting.slots.has_room()
    hosting.worker.messages = [Ended("it crashed")]
    hosting.host.news()
    assert all(hosting.slots.hand_over(solution(9).layers) for _ in range(15)) and not hosting.slots.has_room()
    assert held is not None and np.unique(held.layers) == [1]
