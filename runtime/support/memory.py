"""Memory that was freed, back to the system: the C library keeps what lies between pieces that are still in use."""

from __future__ import annotations

import contextlib
import ctypes
import threading

from runtime.support.priority import BACKGROUND_NICENESS, set_niceness


def give_back() -> bool:
    """Give freed memory back to the system. False where the C library has no such call. Takes milliseconds."""
    try:
        return bool(ctypes.CDLL(None).malloc_trim(0))
    except (OSError, AttributeError):
        return False


def give_back_later() -> None:
    """The same on a thread of its own: what was replaced is large, and nobody waits for it."""

    def run() -> None:
        set_niceness(BACKGROUND_NICENESS)
        give_back()

    with contextlib.suppress(RuntimeError):  # no thread to be had: another time
        threading.Thread(target=run, name="memory", daemon=True).start()
