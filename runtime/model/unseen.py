"""What a picture does not show of a raster, made up so that no panel works for it.

A picture may end within the panels. What the eye would see beside it nobody knows, but panels are driven for it: where
that contradicts what the other eye sees there, the other eye loses. So what one picture does not show is taken from
the other one, as a point of the centre panel looks the same to both; what neither shows goes on as their edge does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime.records import F64, U8


class Shown(NamedTuple):
    """What a picture shows of some rows of a raster: whole pixels, from the first to beyond the last; none: 0, 0."""

    first: NDArray[np.int64]  # (rows,)
    last: NDArray[np.int64]  # (rows,)

    @property
    def any(self) -> NDArray[np.bool_]:
        """(rows,) whether there is one."""
        return self.last > self.first


def shown_of(
    image_from_raster: F64, *, size: tuple[int, int], rows: slice, columns: slice, margin_px: float = 0.0
) -> Shown:
    """What a picture of (width, height), and so many of its pixels around it, shows of a raster's rows and columns.

    image_from_raster: 3x3, of a positive weight before the eye; the centres of the raster's pixels are at halves. Each
    side of the picture is a line on the raster, and what is before the eye and within all four is one run of every row.
    """
    width, height = size
    x, y, w = image_from_raster
    v = np.arange(rows.start, rows.stop) + 0.5
    first, last = np.full(len(v), columns.start + 0.5), np.full(len(v), columns.stop - 0.5)
    low, right, down = margin_px * w, (width + margin_px) * w, (height + margin_px) * w
    for side in (w, x + low, y + low, right - x, down - y):  # each at least 0 within
        offset = side[1] * v + side[2]
        if side[0] == 0:
            last = np.where(offset >= 0, last, columns.start - 0.5)
            continue
        with np.errstate(over="ignore"):  # of a side that is nearly level
            crossed = np.clip(-offset / side[0], columns.start - 0.5, columns.stop + 0.5)
        first, last = (np.maximum(first, crossed), last) if side[0] > 0 else (first, np.minimum(last, crossed))
    begin, end = np.ceil(first - 0.5).astype(np.int64), np.floor(last - 0.5).astype(np.int64) + 1
    some = end > begin
    return Shown(np.where(some, begin, 0), np.where(some, end, 0))


def is_whole(shown: Shown, columns: slice) -> bool:
    """Whether a picture shows all of the rows' columns."""
    return bool((shown.first == columns.start).all() and (shown.last == columns.stop).all())


def extrapolate_border(images: Sequence[U8], shown: Sequence[Shown], *, rows: slice, columns: slice) -> None:
    """In place, rows and columns of both eyes' images (h, w, 4) that their pictures do not show (see above)."""
    known = shown[0].any | shown[1].any
    if not known.any():
        return
    pixels = [image.view(np.uint32)[..., 0] for image in images]
    from runtime.model.compiled.passes import extrapolate_rows  # noqa: PLC0415 - imports numba

    extrapolate_rows(*pixels, *shown[0], *shown[1], rows.start, columns.start, columns.stop)
    there = np.flatnonzero(known)
    for image in pixels:
        drawn = image[rows, columns]
        drawn[: there[0]], drawn[there[-1] + 1 :] = drawn[there[0]], drawn[there[-1]]
