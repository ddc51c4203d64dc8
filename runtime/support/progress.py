"""Report progress on long tasks to an optional listener, which may stop the task.

Functions call `tell` as they proceed, and `listening` installs a listener. An exception raised by the listener ends the
task, so a signal takes effect after at most one step of the task.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TextIO, TypeVar

T = TypeVar("T")
NOW_AND_THEN_S = 10.0  # interval between lines if the stream is not a terminal

# Function that receives the task's name (empty: the task has ended), the number of finished steps, and the total
# number of steps (None: unknown).
Listener = Callable[[str, int, int | None], None]

_LISTENER: ContextVar[Listener | None] = ContextVar("progress", default=None)


def tell(what: str, done: int, total: int | None = None) -> None:
    """Report a task's finished steps, of a known total or not, to any listener, whose exceptions
    propagate. An empty name reports that the task has ended.
    """
    listener = _LISTENER.get()
    if listener is not None:
        listener(what, done, total)


@contextmanager
def task(what: str, *, seconds: float, too_slow: Exception) -> Iterator[None]:
    """Report when the task within the block begins and ends, also to an outer listener. After `seconds`,
    `tell` raises `too_slow` within the block.
    """
    end, outer = time.monotonic() + seconds, _LISTENER.get()

    def check(step: str, done: int, total: int | None) -> None:
        if time.monotonic() > end:
            raise too_slow
        if outer is not None:
            outer(step, done, total)

    tell(what, 0)
    try:
        with listening(check):
            yield
    finally:
        tell("", 0)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send this thread's progress reports to a listener within the block."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows a task's finished and total steps next to its title."""
    try:
        yield lambda done, total: tell(title, done, total)
    finally:
        tell("", 0)


@contextmanager
def status_line(title: str) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a text as a task's current step behind its title."""
    try:
        yield lambda text: tell(f"{title}: {text}", 0)
    finally:
        tell("", 0)


def tracked(title: str, items: Sequence[T]) -> Iterator[T]:
    """Yield a sequence's items, and report progress after each one."""
    with progress_bar(title) as update:
        for number, item in enumerate(items, start=1):
            yield item
            update(number, len(items))


class ShownProgress:
    """Listener that shows long tasks as a bar on a terminal and as occasional lines on other streams."""

    def __init__(self, stream: TextIO, *, after_s: float = 1.0, now_and_then_s: float = NOW_AND_THEN_S) -> None:
        self._stream, self._after_s, self._now_and_then_s = stream, after_s, now_and_then_s
        self._begun_s = self._last_s = 0.0
        self._is_under_way = False
        self._shown: Any = None

    def __call__(self, what: str, done: int, total: int | None) -> None:
        now_s = time.monotonic()
        if not what:
            self._is_under_way = False
            if self._shown is not None:
                self._shown.stop()
                self._shown = None
            return
        if not self._is_under_way:
            self._is_under_way, self._begun_s, self._last_s = True, now_s, now_s
        if self._stream.isatty():
            if now_s - self._begun_s >= self._after_s:
                self._show(what, done, total)
        elif now_s - self._last_s >= self._now_and_then_s:
            self._last_s = now_s
            minutes, seconds = divmod(round(now_s - self._begun_s), 60)
            count = f": {done} of {total}" if total else f": {done}" if done else ""
            with suppress(OSError, ValueError):
                print(f"{minutes}:{seconds:02} {what}{count}", file=self._stream, flush=True)

    def _show(self, what: str, done: int, total: int | None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        if self._shown is None:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._shown = Progress(*columns, console=Console(file=self._stream), transient=True)
            self._shown.add_task(what)
            self._shown.start()
        self._shown.update(0, description=what, completed=done, total=total)
