"""Memory that was freed, back to the system; and a garbage collector that does not hold a refresh up."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import threading
from collections.abc import Iterator

from runtime.support.priority import BACKGROUND_NICENESS, set_niceness


def give_back() -> bool:
    """Give freed memory back to the system; the C library keeps what lies between pieces that are still in use.

    False where the C library has no such call. Takes milliseconds.
    """
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


@contextlib.contextmanager
def gc_frozen() -> Iterator[None]:
    """Within: what there is already is not looked through for garbage.

    Looking through all of what the libraries have made stops every Python thread for several refreshes.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
