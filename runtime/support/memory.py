"""Freed memory: kept for the next frame, or back to the system."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # malloc.h of glibc
LARGEST_KEPT = 32 << 20  # bytes of one block; the most that every glibc accepts
MOST_KEPT = 1 << 30  # bytes free at the heap's end before any go back
ARENAS = 2  # heaps for all threads; by default eight a processor, of which only the first gives its end back


def give_back() -> None:
    """Return freed memory to the system, as far as the C library can.

    Takes milliseconds. Does nothing where the C library has no such call.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@cache
def keep_freed_memory() -> bool:
    """Tell glibc's malloc to keep large blocks for the next frame; False where the C library is another.

    By default each picture is mapped anew and every page of it faults at its first use: measured, a quarter of
    the time of a whole prediction at 1920x1080. All threads share `ARENAS` heaps: each would keep its own most. To be
    called before threads have many.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    told = ((M_ARENA_MAX, ARENAS), (M_MMAP_THRESHOLD, LARGEST_KEPT), (M_TRIM_THRESHOLD, MOST_KEPT))
    return all([mallopt(*setting) for setting in told])
