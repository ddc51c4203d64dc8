"""Jobs on background threads, and thread priorities: presenter, solver, then the rest."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Generic, TypeVar

from runtime.errors import PhasestackError, TransientError, one_line

log = logging.getLogger("phasestack.background")

PRESENTER_NICENESS = -10
SOLVER_NICENESS = 5
BACKGROUND_NICENESS = 10
STOPS_WITHIN_S = 1.2  # of being told to: the rest of two seconds is for what can't be waited for with a limit
T = TypeVar("T")

_ends_by_s = math.inf


_running: set[threading.Thread] = set()
_leaving: set[threading.Thread] = set()


def ends_by(at_s: float) -> None:
    """When, of `time.monotonic`, all waits are over that `patience_s` limits."""
    global _ends_by_s
    _ends_by_s = at_s


def patience_s(most_s: float) -> float:
    """How long to wait for what may be left behind: so long at most, less once told to stop."""
    return max(0.0, min(most_s, _ends_by_s - time.monotonic()))


def wait_for_all(timeout_s: float) -> int:
    """Wait for the jobs that still run, so long at most; how many still do then."""
    deadline_s = time.monotonic() + patience_s(timeout_s)
    for thread in tuple(_running):
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return sum(thread.is_alive() for thread in tuple(_running))


def begin(name: str, run: Callable[..., None], *given: Any) -> threading.Thread:
    """A thread that has been started. Raises TransientError where the system has none left."""
    thread = threading.Thread(target=run, args=given, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise TransientError(f"{name}: {error}") from error
    return thread


class Left(BaseException):
    """Raised on a thread that was asked to leave: nobody waits for what it makes."""


def ask_to_leave(thread: threading.Thread) -> None:
    """Have a thread end its work at the next `leave_if_asked`."""
    _leaving.add(thread)


def leave_if_asked() -> None:
    """Between two pieces of work that hold Python's lock, such as drawings. Raises Left.

    An exception raised in a thread from outside would reach it within moderngl's calls as well, which crash on it.
    """
    if _leaving and threading.current_thread() in _leaving:
        raise Left


class Job(Generic[T]):
    """Begins at once. `done`, `problem` and `take` never wait; one that could not begin has a problem."""

    def __init__(self, name: str, work: Callable[[], T]) -> None:
        self._name, self._work = name, work
        self._result: T | None = None
        self.done = False
        self.problem = ""  # one line, where it failed
        self._thread: threading.Thread | None = None
        try:
            self._thread = begin(f"job {name}", self._run)
        except TransientError as error:
            self.problem, self.done = str(error), True

    def wait(self, timeout_s: float) -> None:
        """Until its thread has ended, so long at most."""
        if self._thread is not None:
            self._thread.join(patience_s(timeout_s))

    def take(self) -> T | None:
        """The result, which is the caller's from now on; None where there is none (yet)."""
        result, self._result = self._result, None
        return result

    def _run(self) -> None:
        _running.add(threading.current_thread())
        set_niceness(BACKGROUND_NICENESS)
        try:
            self._result = self._work()
        except PhasestackError as error:
            self.problem = str(error)
        except BaseException as error:  # whatever a library raises, or a vendor's `sys.exit()`
            self.problem = one_line(f"{self._name}: {type(error).__name__}: {error}")
            log.exception("%s", self._name)
        finally:
            self.done = True
            _running.discard(threading.current_thread())


@contextmanager
def niceness(value: int) -> Iterator[None]:
    """The calling thread's niceness within a block; as it was afterwards."""
    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    set_niceness(value)
    try:
        yield
    finally:
        set_niceness(before)


def set_niceness(niceness: int) -> None:
    """Of the calling thread, and of those that it starts from now on; where the system allows it."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
