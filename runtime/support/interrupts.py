"""An interrupt (Ctrl-C) where it may not become an exception: in imports."""

from __future__ import annotations

import os
import signal
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


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
