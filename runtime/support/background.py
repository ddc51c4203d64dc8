"""One piece of work on a thread of its own, asked about between two steps of whoever wants it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from runtime.errors import PhasestackError
from runtime.support.priority import BACKGROUND_NICENESS, set_niceness

log = logging.getLogger("phasestack.background")

T = TypeVar("T")


_running: set[threading.Thread] = set()


def wait_for_all(timeout_s: float) -> int:
    """Wait for the jobs that still run, so long at most; how many still do then."""
    deadline_s = time.monotonic() + timeout_s
    for thread in tuple(_running):
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return sum(thread.is_alive() for thread in tuple(_running))


class Job(Generic[T]):
    """Begins at once. `done`, `result` and `problem` never wait; a job that is no longer wanted is `abandon`ed."""

    def __init__(self, name: str, work: Callable[[], T], *, discard: Callable[[T], None] = lambda _: None) -> None:
        """discard: what becomes of a result that nobody wants any more."""
        self._name, self._work, self._discard = name, work, discard
        self._lock = threading.Lock()
        self._abandoned = False
        self.done = False
        self.result: T | None = None
        self.problem = ""  # one line, where it failed
        self._thread = threading.Thread(target=self._run, name=f"job {name}", daemon=True)
        _running.add(self._thread)
        self._thread.start()

    def abandon(self) -> None:
        """Its result is discarded, whether it is there already or comes later. May be called twice."""
        with self._lock:
            self._abandoned = True
            result, self.result = self.result, None
        if result is not None:
            self._discard(result)

    def wait(self, timeout_s: float) -> None:
        """Until its thread has ended, so long at most."""
        self._thread.join(timeout_s)

    def take(self) -> T | None:
        """The result, which is the caller's from now on; None where there is none (yet)."""
        with self._lock:
            result, self.result = self.result, None
        return result

    def _run(self) -> None:
        try:
            self._work_through()
        finally:
            _running.discard(self._thread)

    def _work_through(self) -> None:
        result: T | None = None
        set_niceness(BACKGROUND_NICENESS)
        try:
            result = self._work()
        except PhasestackError as error:
            self.problem = str(error)
        except Exception as error:  # whatever a library raises, the loop goes on with what it has
            self.problem = f"{self._name}: {type(error).__name__}: {error}".splitlines()[0]
            log.exception("%s: unexpected error", self._name)
        with self._lock:
            wanted = not self._abandoned
            if wanted:
                self.result = result
            self.done = True
        if not wanted and result is not None:
            self._discard(result)
