"""Run a solver on its own thread, and replace the thread if a call hangs."""

from __future__ import annotations

import logging
import math
import queue
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.errors import ContextLost, FatalError, PhasestackError, Stopped, TransientError
from runtime.frame.effort import REST, SOLVING_STAGES, CostBook, Costs
from runtime.frame.solver import SolverUpdate
from runtime.frame.solver_host import SolverHost, SolverParts, Task, first_request, taken_in
from runtime.records import Effort, SolveRequest
from runtime.support.background import SOLVER_NICENESS, ThreadAbandoned, abandon, begin, patience_s, set_niceness
from runtime.support.memory import give_back
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.solver")

LATE_S = 0.5  # a longer step is late; a single step of more than twice this length is a fault
ABANDON_S = 10.0  # if a step takes longer, its thread is abandoned and a new solver is started
# Starting a solver may take up to `LIMITS.start_s`, and a task up to `LIMITS.load_s`, because it may load content.
IDLE_S = 0.02  # interval for checking for tasks while no requests arrive
USUAL_S = 0.2  # how long a running step gets to finish when the host stops
LATE_STEPS = 3  # this many late steps in a row are a fault; this many steps in a row on time clear it
ANSWER_STEP_MS = 500  # the reported time without an answer is rounded down to a multiple of this
ABANDONED_MAX = 4  # no new solver is started while this many threads hang


class _Attempt:
    """State of a thread that runs one solver. Once the thread is abandoned, its results are ignored."""

    def __init__(self, number: int) -> None:
        self.number, self.abandoned = number, threading.Event()
        self.ready = threading.Event()
        self.busy_since_ns = 0  # when the current step or task started; 0 while idle
        self.effort: Effort | None = None  # effort of the current step
        self.is_at_task = False
        self.took_ns: deque[int] = deque(maxlen=LATE_STEPS)  # durations of the latest steps
        self.costs: CostBook | None = None  # solution costs measured on this machine with this scene
        self.error: BaseException | None = None  # the error that ended the thread
        self.thread: threading.Thread | None = None

    def leave(self) -> None:
        """Make the thread end at its next drawing call, because drawing takes the GIL again and again."""
        if self.thread is not None and self.thread is not threading.current_thread():
            abandon(self.thread)


class SolverThread(SolverHost):
    """Runs a solver in parallel with the presenter.

    If the solver hangs, its thread is abandoned, and a new solver is started on a new thread. Neither `post` nor `news`
    ever waits for the solver.
    """

    def __init__(self, make: Callable[[], SolverParts], clock: Clock) -> None:
        """Start a solver on a new thread.

        Args:
            make: Function that creates a solver and its GL context on the thread calling it. It is called again after a
                hang or an error.
            clock: The run's clock.
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
        """Wait until the solver is ready for requests.

        Args:
            go_on: Function polled during the wait. If it returns False, waiting ends without an error.
            max_s: How long to wait at most, in seconds.

        Raises:
            FatalError: The solver is not ready after `max_s`.
            BaseException: The error that prevented the solver from starting.
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
        return self._costs or Costs({})  # no costs are known if a run is stopped during startup

    def free_ns(self, now_ns: int) -> int:
        attempt, costs = self._attempt, self._costs
        begun_ns, effort = attempt.busy_since_ns, attempt.effort
        if not begun_ns or effort is None or costs is None:
            return now_ns
        return max(begun_ns + round(costs.ms(effort) * NS_PER_MS), now_ns)

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
        """Stop the solver and wait for its thread to end.

        Does not wait for a solver that is still starting, because `commands.guard` ends the process.

        Args:
            timeout_s: How long to wait at most, in seconds.
        """
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
        """Replace the thread if it has hung, and return the reason why the solver is unavailable or late.

        Returns "" if the solver is working on time.
        """
        attempt = self._attempt
        since_ns = attempt.busy_since_ns  # read once, because the solver's thread sets it to 0 at any time
        busy_ns = self._clock.now_ns() - since_ns if since_ns else 0
        if attempt.error is not None:
            if busy_ns > self._abandon_ns:
                with suppress(TransientError):  # no thread is available, so the next refresh tries again
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
            with suppress(TransientError):  # no thread is available, so the next refresh tries again
                self._attempt = self._begin(attempt.number + 1)
                with self._lock:
                    attempt.abandoned.set()
                self._hung.append(attempt)
                self.restarts += 1
                log.error("the solver has not answered for %.1f s; starting a new one", busy_ns / NS_PER_S)
        busy_ms = busy_ns // NS_PER_MS // ANSWER_STEP_MS * ANSWER_STEP_MS
        return f"the solver {'has not answered' if attempt.ready.is_set() else 'has been restarting'} for {busy_ms} ms"

    def _begin(self, number: int) -> _Attempt:
        attempt = _Attempt(number)
        attempt.busy_since_ns = self._clock.now_ns() if number > 1 else 0
        attempt.thread = begin(f"solver-{number}", self._live, attempt)
        return attempt

    def _live(self, attempt: _Attempt) -> None:
        self._run(attempt)
        if not self._closing.is_set():  # returns hundreds of MiB that the next solver's thread could not use
            give_back()

    def _run(self, attempt: _Attempt) -> None:
        with suppress(ThreadAbandoned):
            self._solve(attempt)

    def _solve(self, attempt: _Attempt) -> None:
        set_niceness(SOLVER_NICENESS)
        parts: SolverParts | None = None
        try:
            parts = self._make()
            attempt.costs = CostBook(parts.first_costs(time_ns=self._clock.now_ns()))
            first = parts.step(first_request(self._clock.now_ns()))
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
                if attempt.abandoned.is_set():  # during a task, so the run's model is now another solver's
                    break
                self._adopt_model(attempt, parts)
                request = self._next_request()
                if request is not None:
                    self._step(attempt, parts, request)
        except (ContextLost, Stopped) as error:
            log.error("solver: %s", _line(error))  # only the text, because a traceback keeps large objects alive
            attempt.error, attempt.busy_since_ns = error.with_traceback(None), self._clock.now_ns()
        except ThreadAbandoned:
            raise
        except BaseException as error:  # unexpected, due to a bug in this program or in a library
            log.exception("solver")
            attempt.error, attempt.busy_since_ns = error.with_traceback(None), self._clock.now_ns()
        finally:
            parts.close()
            if attempt.abandoned.is_set():  # no longer needed, but might keep large objects alive
                attempt.error = None

    def _adopt_model(self, attempt: _Attempt, parts: SolverParts) -> None:
        """Discard the measured costs if a task has replaced the model, because rasters and costs may differ."""
        assert attempt.costs is not None
        attempt.busy_since_ns, attempt.is_at_task = self._clock.now_ns(), True
        first = parts.first_costs(time_ns=self._clock.now_ns())
        attempt.busy_since_ns, attempt.is_at_task = 0, False
        if first != attempt.costs.first:
            attempt.costs = CostBook(first)
            self._costs = attempt.costs.costs()

    def _next_request(self) -> SolveRequest | None:
        with self._lock:
            if self._request is None and not self._closing.is_set():
                self._lock.wait(IDLE_S)
            request, self._request = self._request, None
        return request

    def _step(self, attempt: _Attempt, parts: SolverParts, request: SolveRequest) -> None:
        attempt.effort = request.effort
        attempt.busy_since_ns = self._clock.now_ns()
        step = parts.step(request)
        attempt.took_ns.append(self._clock.now_ns() - attempt.busy_since_ns)
        attempt.busy_since_ns, attempt.effort = 0, None
        if self._publish(attempt, step) and step.solution is not None:
            assert attempt.costs is not None and step.solution.effort is not None
            stages = step.solution.stage_ms
            rest_ms = max(
                attempt.took_ns[-1] / NS_PER_MS - sum(stages.get(stage, 0.0) for stage in SOLVING_STAGES), 0.0
            )
            attempt.costs.learn(step.solution.effort, {**stages, REST: rest_ms})
            self._costs = attempt.costs.costs()

    def _publish(self, attempt: _Attempt, step: SolverUpdate) -> bool:
        """Add a step's results to the news, and return True unless this thread has been abandoned."""
        with self._lock:
            if not attempt.abandoned.is_set():
                self._news = taken_in(self._news, step)
            return not attempt.abandoned.is_set()

    def _do_tasks(self, attempt: _Attempt, parts: SolverParts) -> None:
        """Run each queued task once. If a task is not finished, queue it again to run after the next step."""
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
