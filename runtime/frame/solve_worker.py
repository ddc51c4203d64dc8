"""Second thread of a solver: solves one drawn request while the next is drawn."""

from __future__ import annotations

import threading
from collections.abc import Callable

from runtime.clock import Clock
from runtime.frame.solver import DrawnRequest, SolverUpdate
from runtime.support.background import SOLVER_NICENESS, abandon, begin, set_niceness


class SolveWorker:
    """Solves drawn requests one after the other. Used by one thread, except for `since_ns` and `leave`."""

    def __init__(self, name: str, solve: Callable[[DrawnRequest], SolverUpdate], clock: Clock) -> None:
        """solve: called on the worker's thread, which starts with the first request."""
        self._name, self._solve, self._clock = name, solve, clock
        self._changed = threading.Condition()
        self._drawn: DrawnRequest | None = None
        self._outcome: SolverUpdate | BaseException | None = None
        self._closing = False
        self._thread: threading.Thread | None = None
        self.since_ns = 0  # start of the request being solved; 0: idle

    @property
    def drawn(self) -> DrawnRequest | None:
        """Return the request that was handed over last, until its result is taken."""
        return self._drawn

    def begin(self, drawn: DrawnRequest) -> None:
        """Solve a request; the result of the previous one must have been taken. Raises TransientError."""
        assert self._drawn is None
        if self._thread is None:
            self._thread = begin(self._name, self._run)
        with self._changed:
            self._drawn, self.since_ns = drawn, self._clock.now_ns()
            self._changed.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Wait until the worker is idle. Returns False after `timeout_s`."""
        with self._changed:
            return self._changed.wait_for(lambda: self._drawn is None or self._outcome is not None, timeout_s)

    def take(self) -> tuple[DrawnRequest, SolverUpdate] | None:
        """Return a finished request with its result, once. Raises the exception that ended it."""
        with self._changed:
            drawn, outcome = self._drawn, self._outcome
            if drawn is None or outcome is None:
                return None
            self._drawn = self._outcome = None
        if isinstance(outcome, BaseException):
            raise outcome
        return drawn, outcome

    def leave(self) -> None:
        """Abandon the request being solved."""
        if self._thread is not None:
            abandon(self._thread)

    def close(self) -> None:
        """Wait for the request being solved, however long it takes, and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        set_niceness(SOLVER_NICENESS)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or (self._drawn is not None and self._outcome is None))
                if self._closing:
                    return
                drawn = self._drawn
            assert drawn is not None
            outcome: SolverUpdate | BaseException
            try:
                outcome = self._solve(drawn)
            except BaseException as error:  # raised again on the solver's thread
                outcome = error
            with self._changed:
                self.since_ns, self._outcome = 0, outcome
                self._changed.notify_all()
