"""How far a long piece of work is: the work tells, whoever started it listens, and may stop it.

Readers call `tell` as they go. Nobody need listen; who wants to does so with `listening`, and an exception that the
listener raises ends the work: so a signal is heard within one step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[str, int, int | None], None]  # what is done, how many of them, of how many (None: not known)

_LISTENER: ContextVar[Listener | None] = ContextVar("progress", default=None)


def tell(what: str, done: int, total: int | None = None) -> None:
    """Say that `done` of `total` are done."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(what, done, total)


@contextmanager
def within(seconds: float, too_slow: Exception) -> Iterator[None]:
    """Within this block a `tell` that comes after the time is up raises `too_slow`; whoever listens goes on hearing."""
    end, outer = time.monotonic() + seconds, _LISTENER.get()

    def check(what: str, done: int, total: int | None) -> None:
        if time.monotonic() > end:
            raise too_slow
        if outer is not None:
            outer(what, done, total)

    with listening(check):
        yield


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within this block, in this thread, the listener hears every `tell`."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)
