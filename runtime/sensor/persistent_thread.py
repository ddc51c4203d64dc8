"""Calls on threads that live as long as the process, for libraries that ask after every thread that called them.

OpenNI2 does, on its way out: of a thread that has ended and whose stack the system took back, that is a crash. A
`ThreadPoolExecutor`'s would not do: Python ends them before that, and waits for one that hangs in a call.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")

_idle: list[PersistentThread] = []
_lock = threading.Lock()


class PersistentThread:
    """One call at a time; whoever calls waits for it."""

    def __init__(self, name: str) -> None:
        self._asked: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def __call__(self, call: Callable[[], T]) -> T:
        """The answer; raises what the call raises."""
        answer: Future[T] = Future()
        self._asked.put((answer, call))
        return answer.result()

    def _run(self) -> None:
        while True:
            answer, call = self._asked.get()
            try:
                answer.set_result(call())
            except BaseException as error:  # it belongs to who asked
                answer.set_exception(error)
            del answer, call  # nothing of the last call is kept until the next


def borrowed(name: str) -> PersistentThread:
    """A thread that nobody uses; one that hangs in a call is never given back, and another is made."""
    with _lock:
        return _idle.pop() if _idle else PersistentThread(name)


def give_back(thread: PersistentThread) -> None:
    """For the next one who asks."""
    with _lock:
        _idle.append(thread)
