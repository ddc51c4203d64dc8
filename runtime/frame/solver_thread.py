"""Run a solver on a thread, which is abandoned and replaced if a call hangs."""

from __future__ import annotations

import logging
import math
import queue
import threading
from collections import defaultdict, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.errors import ContextLost, FatalError, PhasestackError, Stopped, TransientError
from runtime.frame.effort import CostBook, Costs
from runtime.frame.solver import SolverUpdate
from runtime.frame.solver_host import FIRST_REQUEST, SolverHost, SolverParts, Task, taken_in
from runtime.records import SolveRequest
from runtime.support.background import SOLVER_NICENESS, ThreadAbandoned, abandon, begin, patience_s, set_niceness
from runtime.support.memory import give_back
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.solver")

LATE_S = 0.5  # a longer step is late; a single step that takes twice this is a fault
ABANDON_S = 10.0  # a step that takes longer is abandoned, and a new solver is started
# Starting a solver may take `LIMITS.start_s`, and a task, which loads content, `LIMITS.load_s`.
IDLE_S = 0.02  # interval between checks for tasks while requests are absent
USUAL_S = 0.2  # when stopping, a running step gets this long to finish
LATE_STEPS = 3  # this many consecutive late steps raise a fault; this many on time clear it
ANSWER_STEP_MS = 500  # resolution of the reported time without an answer
ABANDONED_MAX = 4  # with this many hung threads, no new solver is started


class _Attempt:
    """One thread with one solver. Once it is abandoned, its results are ignored."""

    def __init__(self, number: int) -> None:
        self.number, self.abandoned = number, threading.Event()
        self.ready = threading.Event()
        self.busy_since_ns = 0  # 0: idle
        self.is_at_task = False
        self.took_ns: deque[int] = deque(maxlen=LATE_STEPS)  # durations of the last steps
        self.costs: CostBook | None = None  # measured on this machine and scene
        self.error: BaseException | None = None
        self.thread: threading.Thread | None = None

    def leave(self) -> None:
        """Make the thread give up between two drawing calls, because drawing keeps taking the GIL."""
        if self.thread is not None and self.thread is not threading.current_thread():
            abandon(self.thread)


class SolverThread(SolverHost):
    """Host that runs a solver in parallel with the presenter. `post`, `news` and `watch` never wait."""

    def __init__(self, make: Callable[[], SolverParts], clock: Clock) -> None:
        """Start a solver on a new thread.

        make: function that creates a solver, with its own GL context, on the thread that calls it. It is called again
        after a hang.
        """
        self._make, self._clock = make, clock
        self._late_ns, self._abandon_ns = round(LATE_S * NS_PER_S), round(ABANDON_S * NS_PER_S)
        self._lock = threading.Condition()
        self._request: SolveRequest | None = None
        self._news = SolverUpdate()
        self._tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._hung: list[_Attempt] = []
        self._is_late = False
        self._costs: Costs | None = None  # None until the first solver is ready
        self.restarts = 0
        self._attempt = self._begin(1)

    def wait_ready(self, go_on: Callable[[], bool] = lambda: True, *, max_s: float = math.inf) -> None:
        """Wait until the solver accepts requests.

        go_on: function that is polled and returns False to stop waiting. Raises the error that prevented the start,
        or FatalError after `max_s`.
        """
        begun_ns = self._clock.now_ns()
        while not self._attempt.ready.wait(0.1):
            if not go_on():
                return
            if self._clock.now_ns() - begun_ns > max_s * NS_PER_S:
                raise FatalError(f"the scene and the model were not ready within {max_s:g} s")
        if self._attempt.error is not None:
            raise self._attempt.error

    @property
    def costs(self) -> Costs:
        return self._costs or Costs(defaultdict(dict))  # needed once if a run is stopped while it starts

    def post(self, request: SolveRequest) -> None:
        with self._lock:
            self._request = request
            self._lock.notify()

    def news(self) -> SolverUpdate:
        late = self._late_reason()
        news = self._news
        if not late:
            return news
        return replace(news, missing={**news.missing, "model": late})

    def do(self, task: Task) -> None:
        self._tasks.put(task)

    def close(self, timeout_s: float = 1.0) -> None:
        """Stop. A solver that is still starting is not waited for (`commands.guard` ends the process)."""
        self._closing.set()
        with self._lock:
            self._lock.notify_all()
        newest, here = self._attempt, threading.current_thread()
        thread = newest.thread if newest.ready.is_set() and newest.thread is not here else None
        if thread is not None:
            thread.join(patience_s(min(USUAL_S, timeout_s)))
        for attempt in (newest, *self._hung):
            attempt.leave()
        if thread is not None:
            thread.join(patience_s(timeout_s))

    def _late_reason(self) -> str:
        """Return why the solver is unavailable or late, otherwise "". Replaces a hung thread."""
        attempt = self._attempt
        busy_ns = self._clock.now_ns() - attempt.busy_since_ns if attempt.busy_since_ns else 0
        if attempt.error is not None:
            if busy_ns > self._abandon_ns:
                with suppress(TransientError):  # no thread available
                    self._attempt = self._begin(attempt.number + 1)
            return f"the solver failed and is restarting: {_line(attempt.error)}"
        if busy_ns <= 2 * self._late_ns:
            steps = tuple(attempt.took_ns)
            late = sum(took_ns > self._late_ns for took_ns in steps)
            self._is_late = late == LATE_STEPS or (self._is_late and late > 0)
            took_ms, limit_ms = max(steps, default=0) / NS_PER_MS, self._late_ns / NS_PER_MS
            return f"solutions take {took_ms:.0f} ms, more than the limit of {limit_ms:.0f} ms" if self._is_late else ""
        abandon_ns = self._abandon_ns
        if not attempt.ready.is_set() or attempt.is_at_task:
            limit_s = LIMITS.load_s if attempt.ready.is_set() else LIMITS.start_s
            abandon_ns = max(abandon_ns, round(limit_s * NS_PER_S))
        if busy_ns > abandon_ns:
            self._hung = [hung for hung in self._hung if hung.thread is not None and hung.thread.is_alive()]
        if busy_ns > abandon_ns and len(self._hung) < ABANDONED_MAX:
            with suppress(TransientError):  # no thread available: retried at the next refresh
                self._attempt = self._begin(attempt.number + 1)
                with self._lock:
                    attempt.abandoned.set()
                self._hung.append(attempt)
                self.restarts += 1
                log.error("the solver has not answered for %.1f s; starting a new one in its place", busy_ns / NS_PER_S)
        busy_ms = busy_ns // NS_PER_MS // ANSWER_STEP_MS * ANSWER_STEP_MS
        return f"the solver {'has not answered' if attempt.ready.is_set() else 'has been restarting'} for {busy_ms} ms"

    def _begin(self, number: int) -> _Attempt:
        attempt = _Attempt(number)
        attempt.busy_since_ns = self._clock.now_ns() if number > 1 else 0
        attempt.thread = begin(f"solver-{number}", self._live, attempt)
        return attempt

    def _live(self, attempt: _Attempt) -> None:
        self._run(attempt)
        if not self._closing.is_set():  # return hundreds of MiB that the next solver's thread could not reuse
            give_back()

    def _run(self, attempt: _Attempt) -> None:
        with suppress(ThreadAbandoned):
            self._solve(attempt)

    def _solve(self, attempt: _Attempt) -> None:
        set_niceness(SOLVER_NICENESS)
        parts: SolverParts | None = None
        try:
            parts = self._make()
            attempt.costs = CostBook(parts.first_costs())
            first = parts.step(FIRST_REQUEST)
        except BaseException as error:
            if parts is not None:
                parts.close()
            attempt.error, attempt.busy_since_ns = error, self._clock.now_ns()
            attempt.ready.set()
            if attempt.number > 1 and not isinstance(error, PhasestackError | ThreadAbandoned):
                log.exception("the solver could not be restarted")
            return
        self._publish(attempt, first)
        self._costs = attempt.costs.costs()
        attempt.busy_since_ns = 0
        attempt.ready.set()
        try:
            while not (attempt.abandoned.is_set() or self._closing.is_set()):
                self._do_tasks(attempt, parts)
                self._adopt_model(attempt, parts)
                request = self._next_request()
                if request is not None:
                    self._step(attempt, parts, request)
        except (ContextLost, Stopped) as error:
            log.error("solver: %s", _line(error))  # log only text, because the error's frames keep large objects alive
            attempt.error, attempt.busy_since_ns = error.with_traceback(None), self._clock.now_ns()
        except ThreadAbandoned:
            raise
        except BaseException as error:  # not an expected failure but a bug, here or in a library
            log.exception("solver")
            attempt.error, attempt.busy_since_ns = error.with_traceback(None), self._clock.now_ns()
        finally:
            parts.close()
            if attempt.abandoned.is_set():  # no longer needed, and its frames keep large objects alive
                attempt.error = None

    def _adopt_model(self, attempt: _Attempt, parts: SolverParts) -> None:
        """Discard measured costs if a task has replaced the model, whose rasters and costs may differ."""
        assert attempt.costs is not None
        if (first := parts.first_costs()) != attempt.costs.first:
            attempt.costs = CostBook(first)
            self._costs = attempt.costs.costs()

    def _next_request(self) -> SolveRequest | None:
        with self._lock:
            if self._request is None and not self._closing.is_set():
                self._lock.wait(IDLE_S)
            request, self._request = self._request, None
        return request

    def _step(self, attempt: _Attempt, parts: SolverParts, request: SolveRequest) -> None:
        attempt.busy_since_ns = self._clock.now_ns()
        step = parts.step(request)
        attempt.took_ns.append(self._clock.now_ns() - attempt.busy_since_ns)
        attempt.busy_since_ns = 0
        if self._publish(attempt, step) and step.solution is not None:
            assert attempt.costs is not None and step.solution.effort is not None
            attempt.costs.learn(step.solution.effort, step.solution.stage_ms)
            self._costs = attempt.costs.costs()

    def _publish(self, attempt: _Attempt, step: SolverUpdate) -> bool:
        """Add the results of a step to the news. Return False if this attempt has been abandoned."""
        with self._lock:
            if not attempt.abandoned.is_set():
                self._news = taken_in(self._news, step)
            return not attempt.abandoned.is_set()

    def _do_tasks(self, attempt: _Attempt, parts: SolverParts) -> None:
        """Run each task once. Unfinished tasks are queued again, to run after the next step."""
        for _ in range(self._tasks.qsize()):
            if attempt.abandoned.is_set():
                return
            task = self._tasks.get()
            attempt.busy_since_ns, attempt.is_at_task = self._clock.now_ns(), True
            try:
                done = task(parts)
            except Exception:
                log.exception("a task of the solver failed")
                done = True
            attempt.busy_since_ns, attempt.is_at_task = 0, False
            if not done:
                self._tasks.put(task)


def _line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
