"""An interrupt (Ctrl-C) where it may not become an exception: in imports, and in calls that end badly of one."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130


@contextmanager
def imports_end_at_once() -> Iterator[None]:
    """Within it nothing but imports may happen: nothing is open and nothing is written, so that an interrupt needs no
    unwinding. As an exception it would be lost where it came while Python releases a module's lock.

    An interrupt that is ignored (a job in the shell's background) or handled stays so. On the main thread.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """An interrupt within it comes at its end, to whoever took it before: for short calls of libraries that call
    Python themselves, and do not look whether that raised.

    Any thread may call it; only the main one's is ever interrupted.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    came = False

    def remember(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True

    signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
