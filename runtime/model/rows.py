"""Elementwise work on images, a few rows at a time: what one step writes is still in the cache for the next."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

ROWS = 16


class RowPool:
    """Calls a function on strips of rows, on a few threads (numpy releases the interpreter's lock)."""

    def __init__(self, threads: int) -> None:
        self._threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self._threads, "rows") if self._threads > 1 else None

    def each(self, height: int, work: Callable[[slice], None]) -> None:
        """`work` on every strip of `height` rows; strips don't overlap. What it raises is raised here."""

        def share(index: int) -> None:
            for start in range(index * ROWS, height, self._threads * ROWS):
                work(slice(start, min(start + ROWS, height)))

        if self._pool is None:
            share(0)
        else:
            list(self._pool.map(share, range(self._threads)))

    def close(self) -> None:
        """End the threads. May be called twice."""
        if self._pool is not None:
            self._pool.shutdown(wait=False)
