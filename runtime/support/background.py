"""Background threads and jobs, and the presenter's priority over them.

No thread of the presenter's process is less urgent than the solver: while it holds Python's lock, other work could keep
it off the processors, and the presenter would wait for it. Long computations run in separate processes.
"""

from __future__ import annotations

import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Generic, TypeVar

from runtime.errors import PhasestackError, TransientError, one_line

log = logging.getLogger("phasestack.background")

PRESENTER_NICENESS = -10  # used if realtime priority is not allowed
REALTIME_PRIORITY = 1  # lowest realtime priority, which still takes precedence over every ordinary thread
SWITCH_S = 0.0005  # after which a thread that waits for Python's lock asks for it
BACKGROUND_NICENESS = 10  # for processes whose work is not urgent
# Time limit for waits after a stop request. The rest of the two seconds is left for calls without a timeout.
STOPS_WITHIN_S = 1.2
T = TypeVar("T")

_ends_by_s = math.inf
_running: set[threading.Thread] = set()


def ends_by(at_s: float) -> None:
    """Set a deadline, in `time.monotonic` seconds, that limits all later results of `patience_s`."""
    global _ends_by_s
    _ends_by_s = at_s


def patience_s(most_s: float) -> float:
    """Return how long to wait for a thread to end: `most_s`, but not past the deadline."""
    return max(0.0, min(most_s, _ends_by_s - time.monotonic()))


def wait_for_all(timeout_s: float) -> int:
    """Wait up to `timeout_s` for all running jobs, and return the number of jobs still unfinished."""
    deadline_s = time.monotonic() + patience_s(timeout_s)
    for thread in tuple(_running):
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return sum(thread.is_alive() for thread in tuple(_running))


def begin(name: str, run: Callable[..., None], *args: Any) -> threading.Thread:
    """Start and return a daemon thread. Raises TransientError if the system cannot create a thread."""
    thread = threading.Thread(target=run, args=args, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise TransientError(f"{name}: no thread can be started: too little memory, or too many threads") from error
    return thread


class BackgroundJob(Generic[T]):
    """Job on a background thread, started on construction. `done`, `problem` and `take` never block."""

    def __init__(self, name: str, work: Callable[[], T]) -> None:
        self._name, self._work = name, work
        self._result: T | None = None
        self.done = False
        self.problem = ""  # one-line reason why the job failed; empty: no failure
        self._thread: threading.Thread | None = None
        try:
            self._thread = begin(f"job {name}", self._run)
        except TransientError as error:
            self.problem, self.done = str(error), True

    def wait(self, timeout_s: float) -> None:
        """Wait for the job to end, for at most `timeout_s` and not beyond the deadline set by `ends_by`."""
        if self._thread is not None:
            self._thread.join(patience_s(timeout_s))

    def take(self) -> T | None:
        """Return the result once. Returns None before the job is done and after the result has been taken."""
        result, self._result = self._result, None
        return result

    def _run(self) -> None:
        _running.add(threading.current_thread())
        try:
            self._result = self._work()
        except PhasestackError as error:
            self.problem = str(error)
        except BaseException as error:  # includes SystemExit, which a vendor's code may raise
            self.problem = one_line(f"{self._name}: {type(error).__name__}: {error}")
            log.exception("%s", self._name)
        finally:
            self.done = True
            _running.discard(threading.current_thread())


@contextmanager
def before_all_others() -> Iterator[None]:
    """Give the calling thread realtime priority within the block or, if not allowed, a low niceness. At
    ordinary priority, the kernel lets a busy thread finish its time slice first, which would delay a refresh by up to 3
    ms. Threads and processes started within the block have ordinary priority. Python's lock has no priorities: other
    threads of this process are asked to give it up after `SWITCH_S` instead of 5 ms.
    """
    interval_s = sys.getswitchinterval()
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(REALTIME_PRIORITY))
    except OSError:
        set_niceness(PRESENTER_NICENESS)
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)
        os.sched_setscheduler(0, policy, parameters)
        set_niceness(before)


def set_niceness(niceness: int) -> None:
    """Set the niceness, -20 (first) to 19, of this thread and those it starts, if allowed."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
