"""How far a long piece of work is: the work tells, whoever started it listens, and may stop it.

Readers call `tell` as they go. Nobody need listen; who wants to does so with `listening`, and an exception that the
listener raises ends the work: so a signal is heard within one step.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import TextIO

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
        self._begin_s = self._told_s = time.monotonic()

    def __call__(self, text: str) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s < self._every_s:
            return
        self._told_s = now_s
        minutes, seconds = divmod(round(now_s - self._begin_s), 60)
        with suppress(OSError, ValueError):
            self._stream.write(f"{minutes}:{seconds:02} {text}\n")
            self._stream.flush()


class TerminalLine:
    """A listener that shows a task which takes long on one line of a terminal, and takes the line away at its end.

    Where the stream is no terminal it tells now and then.
    """

    def __init__(
        self, stream: TextIO, *, after_s: float = 1.0, every_s: float = 0.25, now_and_then_s: float = NOW_AND_THEN_S
    ) -> None:
        self._stream, self._after_s, self._every_s = stream, after_s, every_s
        self._now_and_then_s = now_and_then_s
        self._lines = NowAndThen(stream, every_s=now_and_then_s)
        self._told: tuple[str, int, int | None] = ("", 0, None)
        self._ended: threading.Event | None = None  # of the task under way

    def __call__(self, what: str, done: int, total: int | None) -> None:
        self._told = (what, done, total)
        if not what:
            if self._ended is not None:
                self._ended.set()
                self._ended = None
        elif not self._stream.isatty():
            if done == 0 and total is None:
                self._lines = NowAndThen(self._stream, every_s=self._now_and_then_s)
            self._lines(what + (f": {done} of {total}" if total else f": {done}" if done else ""))
        elif self._ended is None and done == 0:
            self._ended = threading.Event()
            threading.Thread(target=self._show, args=(self._ended,), name="progress", daemon=True).start()

    def _show(self, ended: threading.Event) -> None:
        if ended.wait(self._after_s):
            return
        with suppress(OSError, ValueError):
            while not ended.wait(self._every_s):
                what, done, total = self._told
                count = f" {done} of {total}" if total else f" {done}" if done else ""
                self._stream.write(f"\r\x1b[K{what}{count}")
                self._stream.flush()
            self._stream.write("\r\x1b[K")
            self._stream.flush()
