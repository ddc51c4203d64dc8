"""Whose turn comes first where threads compete for too few cores: the presenter's, then the solver's, then the rest."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

log = logging.getLogger("phasestack.priority")

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


def set_niceness(niceness: int) -> bool:
    """Of the calling thread, and of those that it starts from now on. False where the system does not allow it."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
    except (OSError, AttributeError):
        log.debug("this thread's niceness can't become %d here", niceness)
        return False
    return True
