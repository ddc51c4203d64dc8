"""Background threads, with priorities (presenter, solver, then the rest), abandonment and jobs."""

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

PRESENTER_NICENESS = -10  # where realtime priority is not allowed
REALTIME_PRIORITY = 1  # the lowest, which still comes before every ordinary thread
SOLVER_NICENESS = 5
BACKGROUND_NICENESS = 10
MEASURING_NICENESS = 15  # for measurements and writing files, which are not urgent
STOPS_WITHIN_S = 1.2  # time limit after a stop request; leaves time for calls without a timeout within two seconds
T = TypeVar("T")

_ends_by_s = math.inf
_running: set[threading.Thread] = set()
_abandoned: set[threading.Thread] = set()


def ends_by(at_s: float) -> None:
    """Set the deadline, in `time.monotonic` seconds, for every wait that `patience_s` limits."""
    global _ends_by_s
    _ends_by_s = at_s


def patience_s(most_s: float) -> float:
    """Return how long to wait for a thread that may be abandoned: `most_s` or until the deadline."""
    return max(0.0, min(most_s, _ends_by_s - time.monotonic()))


def wait_for_all(timeout_s: float) -> int:
    """Wait for running jobs and return how many have not finished after `timeout_s`."""
    deadline_s = time.monotonic() + patience_s(timeout_s)
    for thread in tuple(_running):
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return sum(thread.is_alive() for thread in tuple(_running))


def begin(name: str, run: Callable[..., None], *args: Any) -> threading.Thread:
    """Start a thread. Raises TransientError if the system cannot create one."""
    thread = threading.Thread(target=run, args=args, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise TransientError(f"{name}: {error}") from error
    return thread


class ThreadAbandoned(BaseException):
    """Raised on an abandoned thread, whose result is no longer wanted."""


def abandon(thread: threading.Thread) -> None:
    """Abandon a thread, whose next call to `raise_if_abandoned` raises."""
    _abandoned.add(thread)


def raise_if_abandoned() -> None:
    """Raise ThreadAbandoned on an abandoned thread. Called between operations such as drawing.

    An asynchronous exception could arrive inside a call to moderngl, which would crash.
    """
    if _abandoned and threading.current_thread() in _abandoned:
        raise ThreadAbandoned


class BackgroundJob(Generic[T]):
    """Job that starts on construction. `done`, `problem` and `take` never block."""

    def __init__(self, name: str, work: Callable[[], T], *, niceness: int = BACKGROUND_NICENESS) -> None:
        self._name, self._work, self._niceness = name, work, niceness
        self._result: T | None = None
        self.done = False
        self.problem = ""  # reason in one line if the job failed
        self._thread: threading.Thread | None = None
        try:
            self._thread = begin(f"job {name}", self._run)
        except TransientError as error:
            self.problem, self.done = str(error), True

    def wait(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` for the thread to end."""
        if self._thread is not None:
            self._thread.join(patience_s(timeout_s))

    def take(self) -> T | None:
        """Return the result, or None if there is none yet or it has been taken."""
        result, self._result = self._result, None
        return result

    def _run(self) -> None:
        _running.add(threading.current_thread())
        set_niceness(self._niceness)
        try:
            self._result = self._work()
        except PhasestackError as error:
            self.problem = str(error)
        except BaseException as error:  # includes a vendor's `sys.exit()`
            self.problem = one_line(f"{self._name}: {type(error).__name__}: {error}")
            log.exception("%s", self._name)
        finally:
            self.done = True
            _running.discard(threading.current_thread())


@contextmanager
def before_all_others() -> Iterator[None]:
    """Give the calling thread realtime priority within a block, or if not allowed, a low niceness.

    At ordinary priority the kernel lets a busy thread finish its slice, which would delay a refresh by up to 3 ms.
    Threads and processes started within the block have ordinary priority.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(REALTIME_PRIORITY))
    except OSError:
        set_niceness(PRESENTER_NICENESS)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)
        set_niceness(before)


def set_niceness(niceness: int, thread: threading.Thread | None = None) -> None:
    """Set the niceness of a thread (default: this one) and of those it starts later, if allowed."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, (thread or threading.current_thread()).native_id or 0, niceness)
