"""Control over freed memory, which can be kept for the next frame or returned to the system."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # malloc.h of glibc
LARGEST_KEPT = 32 << 20  # largest block kept, bytes; the maximum that every glibc accepts
MOST_KEPT = 1 << 30  # free bytes kept at the heap's end
ARENAS = 2  # number of heaps; the default is eight per processor, of which only the first returns memory


def give_back() -> None:
    """Return freed memory to the system, if the C library can. Takes milliseconds."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@cache
def keep_freed_memory() -> bool:
    """Make glibc's malloc keep large blocks for the next frame. Returns False with another C library.

    By default every picture gets a new mapping, and the page faults on first use take a quarter of the time of a
    prediction at 1920x1080. All threads share `ARENAS` heaps, because each heap keeps up to `MOST_KEPT`. Call this
    before starting threads.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    options = ((M_ARENA_MAX, ARENAS), (M_MMAP_THRESHOLD, LARGEST_KEPT), (M_TRIM_THRESHOLD, MOST_KEPT))
    return all([mallopt(*option) for option in options])
