"""Control whether freed memory is kept for the next frame or returned to the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # constants from glibc's malloc.h
LARGEST_KEPT = 32 << 20  # size in bytes of the largest block to keep, the maximum that every glibc accepts
MOST_KEPT = 1 << 30  # number of free bytes kept at the end of a heap
ARENAS = 2  # number of heaps; the default is eight per processor, but only the first returns memory


def give_back() -> None:
    """Return freed memory to the operating system, if the C library can. This takes milliseconds."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@cache
def keep_freed_memory() -> bool:
    """Make glibc's malloc keep large blocks for the next frame. Return False for other C libraries.

    By default, malloc maps new memory for every picture, and the page faults on first use take up a quarter of a
    prediction's time at 1920x1080. All threads share `ARENAS` heaps, because each heap keeps up to `MOST_KEPT` bytes.
    Call this function before threads are started.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    options = ((M_ARENA_MAX, ARENAS), (M_MMAP_THRESHOLD, LARGEST_KEPT), (M_TRIM_THRESHOLD, MOST_KEPT))
    return all([mallopt(*option) for option in options])
