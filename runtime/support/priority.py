"""Whose turn comes first where threads compete for too few cores: the presenter's, then the solver's, then the rest."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PRESENTER_NICENESS = -10
SOLVER_NICENESS = 5
BACKGROUND_NICENESS = 10


@contextmanager
def niceness(value: int) -> Iterator[None]:
    """The calling thread's niceness within a block; as it was afterwards."""
    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    set_niceness(value)
    try:
        yield
    finally:
        set_niceness(before)


def set_niceness(niceness: int) -> None:
    """Of the calling thread, and of those that it starts from now on; where the system allows it."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
