"""Memory that was freed, back to the system; and a garbage collector that does not hold a refresh up."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Iterator


def give_back() -> None:
    """Give freed memory back to the system; the C library keeps what lies between pieces that are still in use.

    Takes milliseconds. Does nothing where the C library has no such call.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


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
