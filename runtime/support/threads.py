"""Parallel loops over work that releases Python's lock (numpy, OpenCV, C++)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import TypeVar

import cv2

PIECE_ROWS = 128  # picture rows per item where `parallel_map` splits a picture
Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_map(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Call `work` on every item, on as many threads as OpenCV may use. Its exceptions propagate."""
    threads = cv2.getNumThreads()
    if threads < 2 or len(items) < 2:
        return [work(item) for item in items]
    others = [_pool(threads).submit(work, item) for item in items[1:]]
    try:
        first = work(items[0])  # on this thread, to wake one thread less
    finally:
        wait(others)
    return [first, *(other.result() for other in others)]


def on_rows(work: Callable[[int, int], None], rows: int, *, threads: int | None = None) -> None:
    """Split `rows` among `threads` (default: OpenCV's) and call `work(begin, end)` in parallel."""
    parts = threads or max(1, cv2.getNumThreads())
    parallel_map(lambda span: work(*span), list(pairwise(rows * part // parts for part in range(parts + 1))))


def fresh_threads() -> None:
    """Have `parallel_map` start new threads, which inherit the niceness of its next caller."""
    _pool.cache_clear()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the thread pool, which is kept because starting a thread takes two milliseconds."""
    return ThreadPoolExecutor(threads, "parallel-map")
