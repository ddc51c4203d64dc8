"""Elementwise work on images, a few rows at a time: what one step writes is still in the cache for the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import prod
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

STRIP = 192 * 1024  # numbers of 16 bits: with what it is made from, a strip stays in a core's own cache
WORTH_A_THREAD = 2 * STRIP  # an image of fewer numbers is done before another thread has woken

Work = Callable[[slice, NDArray[np.int16]], None]
Item = TypeVar("Item")
Result = TypeVar("Result")


class RowPool:
    """Calls a function on strips of rows, on a few threads (numpy releases the interpreter's lock).

    Every call gets a strip of its thread's own to work in: memory that is asked for anew costs more than the work.
    """

    def __init__(self, threads: int, *, width_px: int) -> None:
        """width_px: of the widest image, three channels."""
        self._threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self._threads, "rows") if self._threads > 1 else None
        self._scratch = np.zeros((self._threads, max(STRIP, width_px * 3)), np.int16)

    def each(self, shape: tuple[int, ...], work: Work) -> None:
        """`work` on every strip of rows of an image; strips don't overlap. What it raises is raised here.

        shape: (height, width, 3) or (height, width). `work` gets the rows, and a strip of that shape with anything
        in it.
        """
        height_px, row = shape[0], shape[1:]
        rows = self._scratch.shape[1] // prod(row)

        def share(index: int, of: int) -> None:
            strip = self._scratch[index, : rows * prod(row)].reshape(rows, *row)
            for start in range(index * rows, height_px, of * rows):
                stop = min(start + rows, height_px)
                work(slice(start, stop), strip[: stop - start])

        if self._pool is None or prod(shape) <= WORTH_A_THREAD:
            share(0, 1)
        else:
            list(self._pool.map(share, range(self._threads), [self._threads] * self._threads))

    @property
    def threads(self) -> int:
        """How many calls run at once, at most."""
        return self._threads

    def split(self, numbers: int, work: Callable[[int, int], None]) -> None:
        """`work(index, of)` for each of as many shares as there are threads, of an image of so many numbers."""
        if self._pool is None or numbers <= WORTH_A_THREAD:
            work(0, 1)
        else:
            list(self._pool.map(work, range(self._threads), [self._threads] * self._threads))

    def map(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """`work` of every item, at once where there are threads: for OpenCV's functions that use one thread only."""
        return [work(item) for item in items] if self._pool is None else list(self._pool.map(work, items))

    def close(self) -> None:
        """End the threads. May be called twice."""
        if self._pool is not None:
            self._pool.shutdown(wait=False)
