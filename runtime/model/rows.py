"""Elementwise work on images, a few rows at a time: what one step writes is still in the cache for the next."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import prod

import numpy as np
from numpy.typing import NDArray

ROWS = 32

Work = Callable[[slice, NDArray[np.int16]], None]


class RowPool:
    """Calls a function on strips of rows, on a few threads (numpy releases the interpreter's lock).

    Every call gets a strip of its thread's own to work in: memory that is asked for anew costs more than the work.
    """

    def __init__(self, threads: int, *, width_px: int) -> None:
        """width_px: of the widest image, three channels."""
        self._threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self._threads, "rows") if self._threads > 1 else None
        self._scratch = np.zeros((self._threads, ROWS * width_px * 3), np.int16)

    def each(self, shape: tuple[int, ...], work: Work) -> None:
        """`work` on every strip of rows of an image; strips don't overlap. What it raises is raised here.

        shape: (height, width, 3) or (height, width). `work` gets the rows, and a strip of that shape with anything
        in it.
        """
        height_px, row = shape[0], shape[1:]
        numbers = ROWS * prod(row)

        def share(index: int) -> None:
            strip = self._scratch[index, :numbers].reshape(ROWS, *row)
            for start in range(index * ROWS, height_px, self._threads * ROWS):
                stop = min(start + ROWS, height_px)
                work(slice(start, stop), strip[: stop - start])

        if self._pool is None:
            share(0)
        else:
            list(self._pool.map(share, range(self._threads)))

    def close(self) -> None:
        """End the threads. May be called twice."""
        if self._pool is not None:
            self._pool.shutdown(wait=False)
