"""Freed memory: kept for the next frame, or back to the system."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
LARGEST_KEPT = 32 << 20  # bytes of one block; the most that every glibc accepts
MOST_KEPT = 1 << 30  # bytes free at the heap's end before any go back


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
    the time of a whole prediction at 1920x1080. The peak of memory stays what it was.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)) and bool(mallopt(M_TRIM_THRESHOLD, MOST_KEPT))
