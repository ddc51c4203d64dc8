"""How far a long piece of work is: the work tells, whoever started it listens, and may stop it.

Readers call `tell` as they go. Nobody need listen; who wants to does so with `listening`, and an exception that the
listener raises ends the work: so a signal is heard within one step.
"""

from __future__ import annotations

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
def listening(listener: Listener) -> Iterator[None]:
    """Within this block, in this thread, the listener hears every `tell`."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)
