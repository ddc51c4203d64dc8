"""How far a long piece of work is: the work tells, whoever started it listens, and may stop it.

Readers call `tell` as they go. Nobody need listen; who wants to does so with `listening`, and an exception that the
listener raises ends the work: so a signal is heard within one step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TextIO

NOW_AND_THEN_S = 30.0  # between two lines where nobody watches

Listener = Callable[[str, int, int | None], None]  # what is done, how many of them, of how many (None: not known)

_LISTENER: ContextVar[Listener | None] = ContextVar("progress", default=None)


def tell(what: str, done: int, total: int | None = None) -> None:
    """Say that `done` of `total` are done."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(what, done, total)


@contextmanager
def task(what: str, *, seconds: float, too_slow: Exception) -> Iterator[None]:
    """One piece of work, told as begun (0 done) and as ended (no name).

    A `tell` within it that comes after the time is up raises `too_slow`; whoever listens goes on hearing.
    """
    end, outer = time.monotonic() + seconds, _LISTENER.get()

    def check(told: str, done: int, total: int | None) -> None:
        if time.monotonic() > end:
            raise too_slow
        if outer is not None:
            outer(told, done, total)

    tell(what, 0)
    try:
        with listening(check):
            yield
    finally:
        tell("", 0)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within this block, in this thread, the listener hears every `tell`."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


class NowAndThen:
    """Where long work is, in a log or a pipe: a line once in a while, none of what is quick."""

    def __init__(self, stream: TextIO, *, every_s: float = NOW_AND_THEN_S) -> None:
        self._stream, self._every_s = stream, every_s
        self._begin_s = self._last_s = time.monotonic()

    def __call__(self, text: str) -> None:
        now_s = time.monotonic()
        if now_s - self._last_s < self._every_s:
            return
        self._last_s = now_s
        minutes, seconds = divmod(round(now_s - self._begin_s), 60)
        with suppress(OSError, ValueError):
            self._stream.write(f"{minutes}:{seconds:02} {text}\n")
            self._stream.flush()


class ShownProgress:
    """A listener that shows a task which takes long: on a terminal with rich, elsewhere by a line now and then."""

    def __init__(self, stream: TextIO, *, after_s: float = 1.0, now_and_then_s: float = NOW_AND_THEN_S) -> None:
        self._stream, self._after_s, self._now_and_then_s = stream, after_s, now_and_then_s
        self._lines = NowAndThen(stream, every_s=now_and_then_s)
        self._begun_s: float | None = None
        self._shown: Any = None

    def __call__(self, what: str, done: int, total: int | None) -> None:
        if not what:
            self._begun_s = None
            if self._shown is not None:
                self._shown.stop()
                self._shown = None
            return
        if self._begun_s is None:
            self._begun_s = time.monotonic()
            self._lines = NowAndThen(self._stream, every_s=self._now_and_then_s)
        if not self._stream.isatty():
            self._lines(what + (f": {done} of {total}" if total else f": {done}" if done else ""))
        elif time.monotonic() - self._begun_s >= self._after_s:
            self._show(what, done, total)

    def _show(self, what: str, done: int, total: int | None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        if self._shown is None:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._shown = Progress(*columns, console=Console(file=self._stream), transient=True)
            self._shown.add_task(what)
            self._shown.start()
        self._shown.update(0, description=what, completed=done, total=total)
