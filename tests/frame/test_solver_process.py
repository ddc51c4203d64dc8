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
from runtime.frame import messages as m
from runtime.frame import solver_process
from runtime.frame.effort import Costs
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
        self.next_one, self.files = arguments, files
        self.messages, self.sent, self.ended = list[Any](), list[Any](), list[str]()
        self.fault, self.takes, self.closed = "", True, 0
        self.restart, self.status, self.wait_ready = self.ended.append, lambda: {"role": "solver"}, lambda go_on: None

    def receive(self) -> list[Any]:
        messages, self.messages = self.messages, []
        return messages

    def send(self, message: Any) -> bool:
        if self.takes:
            self.sent.append(message)
        return self.takes

    def close(self) -> None:
        self.closed += 1


class Hosting:
    """A host whose solver has begun to work."""

    def __init__(self) -> None:
        self.clock, self.lost, self.known = SimulatedClock(10**9), 3, Known()
        how: dict[str, Any] = {"contexts_lost": lambda: self.lost, "files": (77,)}
        self.host = SolverProcess(Role("solver", print), STACK, self._setup, self.clock, **how)
        self.worker: Any = self.host._worker
        self.slots = LayerSlots(os.dup(self.worker.files[0]), STACK)  # the solver's
        assert not self.host.is_known and self.worker.files[1:] == (77,)
        self.worker.messages = [Began(1), m.Idle(COSTS, m.Live("loads"), facts(Settings()), COSTS.stages)]
        self.host.wait_ready()
        assert self.host.is_known and (self.host.costs, self.host.live) == (COSTS, m.Live("loads"))

    def _setup(self, known: Known) -> None:
        self.known = known

    def busy(self, effort: Effort | None = None) -> None:
        self.worker.messages.append(m.Busy(self.clock.now_ns(), effort))

    def stepped(self, number: int | None = None, *, took_ms: float = 20.0, flat: int | None = None) -> None:
        """The solver has worked for so long, and perhaps made a solution or a flat picture."""
        solved = None if number is None else solution(number)
        drawn = None if flat is None else solution(flat, None)
        slot, flat_slot = (
            m.Slot(*place) if made is not None and (place := self.slots.hand_over(made.layers)) else None
            for made in (solved, drawn)
        )
        update, took_ns = m.SolverUpdate(solved, drawn, {"content": "busy"}), round(took_ms * NS_PER_MS)
        self.worker.messages.append(m.Stepped(update, slot, flat_slot, took_ns, COSTS, m.Live(), ContentInfo("next")))

    def late(self, *, after_ms: float = 0.0) -> str:
        self.clock.advance_ns(round(after_ms * NS_PER_MS))
        return self.host.news().missing.get("model", "")


@pytest.fixture
def hosting(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hosting]:
    monkeypatch.setattr(solver_process, "Worker", FakeWorker)
    made = Hosting()
    yield made
    for _ in range(2):
        made.host.close()
    assert made.worker.closed == 1


def test_solutions_arrive_in_shared_memory_and_number_the_next_solver_s(hosting: Hosting) -> None:
    hosting.stepped(4, flat=6)
    hosting.stepped(5)
    news = hosting.host.news()
    assert news.solution is not None and news.flat is not None
    assert (news.solution.number, news.flat.number, news.missing) == (5, 6, {"content": "busy"})
    assert np.unique(news.solution.layers) == [5] and np.unique(news.flat.layers) == [6]
    hosting.worker.next_one()
    known = hosting.known
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
        ((501, 501), None), ((501, 500, 501), None), ((501, 700, 501), 700), ((501, 700, 501, 20, 600), 600),
        ((501, 700, 501, 20, 20), 501), ((501, 700, 501, 20, 20, 500), None), ((501, 700, 0, 501), 700),
    ],
)  # fmt: skip
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
    for after_ms, told_ms in ((1, 0), (498, 0), (1, 500)):
        assert hosting.late(after_ms=after_ms) == f"the solver has not answered for {most_ms + told_ms} ms"
    hosting.stepped(5)
    assert hosting.late() == ""


def test_the_first_solution_of_another_scene_may_take_long(hosting: Hosting) -> None:
    hosting.worker.messages.append(m.Done(9, facts=facts(Settings(), scene=2)))
    for number, may_be_late in ((None, False), (None, False), (7, False), (8, True)):
        hosting.busy(Effort())
        assert (hosting.late(after_ms=1001) != "") == may_be_late
        for _ in range(3):
            hosting.stepped(number, took_ms=900)
    assert hosting.host.facts.scene == 2 and hosting.late() == "solutions take 900 ms, more than the limit of 500 ms"
    hosting.busy(Effort())
    hosting.worker.messages.append(Ended("it crashed"))
    hosting.worker.fault = "the solver crashed"
    for after_ms, told in ((0, ""), (499, ""), (1, " (for 500 ms)"), (499, " (for 500 ms)"), (1, " (for 1000 ms)")):
        assert hosting.late(after_ms=after_ms) == f"the solver crashed{told}"
    hosting.worker.fault = ""
    assert hosting.late() == "", "the next one's steps are counted anew"


def test_orders_wait_in_line_and_those_under_way_end_with_their_solver(hosting: Hosting) -> None:
    answers: list[m.Answer] = []
    hosting.host.post(first_request(5))
    skip, draw = (hosting.host.send(order, answers.append) for order in (m.Skip(1), m.Draw({}, None, 40.0)))
    hosting.worker.takes = False
    waiting = hosting.host.send(m.Skip(2), answers.append)
    hosting.worker.takes = True
    last = hosting.host.send(m.Skip(3), answers.append)
    request, *orders = hosting.worker.sent
    assert request == first_request(5) and [order.number for order in orders] == [skip, draw], "the last waits in line"
    hosting.worker.messages, hosting.worker.takes = [m.Progress(skip, "loading"), Ended("it crashed")], False
    hosting.host.news()
    assert answers == [m.Progress(skip, "loading"), m.Done(skip, REPLACED), m.Drawn(draw, None)]
    hosting.worker.takes = True
    hosting.host.news()
    assert [order.number for order in hosting.worker.sent[1:]] == [skip, draw, waiting, last]
    hosting.worker.messages = [m.Done(waiting), m.Done(last)]
    hosting.host.news()
    assert answers[3:] == [m.Done(waiting), m.Done(last)]


def test_a_lost_context_replaces_the_solver_whose_slots_are_free_then(hosting: Hosting) -> None:
    hosting.stepped(1)
    held = hosting.host.news().solution
    assert hosting.worker.ended == [] and hosting.host.status() == [{"role": "solver"}]
    hosting.lost += 1
    for _ in range(2):
        hosting.host.news()
    hosting.host.restart("was ended")
    assert hosting.worker.ended == ["was ended because the panels have lost their OpenGL context", "was ended"]
    for _ in range(2):  # handed over, but never received
        assert all(hosting.slots.hand_over(solution(9).layers) for _ in range(15)) and not hosting.slots.has_room()
        hosting.worker.messages = [Ended("it crashed")]
        hosting.host.news()
    assert held is not None and np.unique(held.layers) == [1]
