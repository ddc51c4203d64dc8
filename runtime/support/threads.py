"""Parallel loops for work that releases Python's global lock (NumPy, OpenCV, C++)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from itertools import islice, pairwise
from typing import TypeVar

import cv2

PIECE_ROWS = 128  # number of picture rows per item when `parallel_map` is used on parts of a picture
Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_map(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Call `work` on every item, in as many threads as OpenCV uses, and return the results in order.
    Exceptions raised by `work` propagate.
    """
    threads = cv2.getNumThreads()
    if threads < 2 or len(items) < 2:
        return [work(item) for item in items]
    others = [_submitted(_pool(threads), work, item) for item in items[1:]]
    try:
        first = work(items[0])  # runs on this thread, to avoid waking another one
    finally:
        wait(others)
    return [first, *(other.result() for other in others)]


def on_rows(work: Callable[[int, int], None], rows: int, *, threads: int | None = None) -> None:
    """Split rows into `threads` parts, by default OpenCV's, for `work(begin, end)` in parallel."""
    parts = threads or max(1, cv2.getNumThreads())
    parallel_map(lambda span: work(*span), list(pairwise(rows * part // parts for part in range(parts + 1))))


def ahead(items: Iterable[Item], count: int) -> Iterator[Item]:
    """Yield the items in order, and read up to `count` of them in advance."""
    source, waiting = iter(items), deque[Item]()
    while True:
        waiting.extend(islice(source, count - len(waiting)))
        if not waiting:
            return
        yield waiting.popleft()


def _submitted(pool: ThreadPoolExecutor, work: Callable[[Item], Result], item: Item) -> Future[Result]:
    """Submit a call to the pool, or make it here if the main thread has ended and no pool takes more calls."""
    try:
        return pool.submit(work, item)
    except RuntimeError:
        done: Future[Result] = Future()
        try:
            done.set_result(work(item))
        except Exception as error:
            done.set_exception(error)
        return done


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the thread pool. Starting a thread takes 2 ms, so the pool is kept between calls."""
    return ThreadPoolExecutor(threads, "parallel-map")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has none of the pool's threads
