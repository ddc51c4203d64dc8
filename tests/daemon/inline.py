"""Solver on a thread of the test's own process, so that a test can break its content and its model."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.daemon.solver_parts import RunningSolver, SolverSetup
from runtime.frame import solver_process
from runtime.frame.effort import CostBook, Costs
from runtime.frame.messages import Answer, Facts, Live, Order, SolverUpdate
from runtime.frame.solver_host import SolverHost, first_request, taken_in
from runtime.records import SolveRequest

WAKES_S = 0.01


class ThreadSolver(SolverHost):
    """Does what a solver's process does, except that it cannot be replaced."""

    def __init__(self, setup: SolverSetup, clock: Clock) -> None:
        super().__init__()
        self._setup, self._clock = setup, clock
        self._orders: queue.SimpleQueue[Order | Callable[[], object]] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._request: SolveRequest | None = None
        self._news, self._costs = SolverUpdate(), Costs({})
        self._wake, self._closing, self._ready = threading.Event(), threading.Event(), threading.Event()
        self._busy_since_ns = 0
        self._error: BaseException | None = None
        self.parts: RunningSolver
        self._thread = threading.Thread(target=self._run, name="solver", daemon=True)
        self._thread.start()

    is_known = True

    def wait_ready(self, go_on: Callable[[], bool] = lambda: True) -> None:
        self._ready.wait()
        if self._error is not None:
            raise self._error

    @property
    def costs(self) -> Costs:
        return self._costs

    @property
    def facts(self) -> Facts:
        return self.parts.facts

    @property
    def live(self) -> Live:
        return self.parts.live(self._clock.now_ns())

    def free_ns(self, now_ns: int) -> int:
        return now_ns

    def post(self, request: SolveRequest) -> None:
        self._request = request
        self._wake.set()

    def news(self) -> SolverUpdate:
        while not self._answers.empty():
            self._answered(self._answers.get())
        since_ns, news = self._busy_since_ns, self._news
        busy_ns = self._clock.now_ns() - since_ns if since_ns else 0
        if busy_ns <= 2 * solver_process.LATE_S * NS_PER_S:
            return news
        late = {"model": f"the solver has not answered for {busy_ns // NS_PER_MS} ms"}
        return SolverUpdate(news.solution, news.flat, news.missing | late)

    def between_steps(self, work: Callable[[], object]) -> None:
        """Have the solver's thread do this between two steps."""
        self._orders.put(work)
        self._wake.set()

    def close(self) -> None:
        self._closing.set()
        self._wake.set()
        self._thread.join(60.0)

    def _dispatch(self, order: Order) -> None:
        self._orders.put(order)
        self._wake.set()

    def _run(self) -> None:
        with ExitStack() as cleanup:
            try:
                self.parts = parts = RunningSolver(self._setup)
                cleanup.callback(parts.close)
                self._costs = CostBook(parts.first_costs(time_ns=self._clock.now_ns())).costs()
                self._news = taken_in(self._news, parts.step(first_request(self._clock.now_ns())))
            except BaseException as error:
                self._error = error
                return
            finally:
                self._ready.set()
            while not self._closing.is_set():
                self._turn(parts)

    def _turn(self, parts: RunningSolver) -> None:
        self._wake.wait(WAKES_S)
        self._wake.clear()
        orders: list[Any] = []
        while not self._orders.empty():
            orders.append(self._orders.get())
        for answer in parts.turn([order for order in orders if not callable(order)]):
            self._answers.put(answer)
        for work in orders:
            if callable(work):
                work()
        request, self._request = self._request, None
        if request is not None:
            self._busy_since_ns = self._clock.now_ns()
            self._news = taken_in(self._news, parts.step(request))
            self._busy_since_ns = 0
