"""Calls on threads that live as long as the process, for libraries that ask after every thread that called them.

OpenNI2 does, on its way out: of a thread that has ended and whose stack the system took back, that is a crash. A
`ThreadPoolExecutor`'s would not do: Python ends them before that, and waits for one that hangs in a call.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")
Answer = tuple[Any, BaseException | None]

_idle: list[PersistentThread] = []
_lock = threading.Lock()


class PersistentThread:
    """One call at a time; whoever calls waits for it."""

    def __init__(self, name: str) -> None:
        self._asked: queue.SimpleQueue[tuple[Callable[[], Any], queue.SimpleQueue[Answer]]] = queue.SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def __call__(self, call: Callable[[], T]) -> T:
        """The answer; raises what the call raises."""
        answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._asked.put((call, answers))
        result, error = answers.get()
        if error is not None:
            raise error
        answer: T = result
        return answer

    def _run(self) -> None:
        while True:
            call, answers = self._asked.get()
            try:
                answer: Answer = call(), None
            except BaseException as error:  # it belongs to who asked
                answer = None, error
            answers.put(answer)
            del call, answers, answer  # nothing of the last call is kept until the next


def borrowed(name: str) -> PersistentThread:
    """A thread that nobody uses; one that hangs in a call is never given back, and another is made."""
    with _lock:
        return _idle.pop() if _idle else PersistentThread(name)


def give_back(thread: PersistentThread) -> None:
    """For the next one who asks."""
    with _lock:
        _idle.append(thread)
