"""Work on several threads, for loops that release the interpreter's lock (numpy, OpenCV, C++)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

import cv2

PIECE_ROWS = 128  # of a picture, that are done at once where `at_once` works on it in pieces
Item = TypeVar("Item")
Result = TypeVar("Result")


def at_once(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """`work` of every item, on as many threads as OpenCV may use; what it raises is raised here."""
    threads = cv2.getNumThreads()
    if threads < 2 or len(items) < 2:
        return [work(item) for item in items]
    return list(_pool(threads).map(work, items))


def on_rows(work: Callable[[int, int], None], rows: int, *, threads: int | None = None) -> None:
    """`work(first, last)` on as many of so many rows for each thread; None: for each of OpenCV's."""
    at_once(lambda part: work(*part), shares(rows, threads or max(1, cv2.getNumThreads())))


def shares(count: int, threads: int) -> list[tuple[int, int]]:
    """As many rows for each thread: the first, and the first beyond."""
    return list(pairwise([count * k // threads for k in range(threads + 1)]))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: a new one begins two milliseconds late."""
    return ThreadPoolExecutor(threads, "at-once")
