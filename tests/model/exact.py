"""Resampling by the definition, in double precision: what both backends are held to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.model.chain import EVEN_COLUMNS, ColumnLaw
from runtime.records import F64

EDGE_PX = 1e-3  # a place on an image's very edge is within


def exact_resample(
    image: NDArray[Any],
    *,
    image_from_result: F64,
    out: NDArray[Any],
    outside: float = 0,
    cubic: bool = False,
    image_columns: ColumnLaw = EVEN_COLUMNS,
    result_columns: ColumnLaw = EVEN_COLUMNS,
) -> NDArray[Any]:
    """`runtime.model.resample.resample`, sample by sample: slow, and without its approximations."""
    m, (height, width) = image_from_result, out.shape[:2]
    bent = image_columns.bend != 0 or result_columns.bend != 0
    sheared = not bent and bool(m[[0, 1, 2, 2], [1, 0, 0, 1]].any())
    v, u = np.mgrid[0:height, 0:width] + 0.5
    u = result_columns.homography_from_column(u)
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in m)
    x, y = image_columns.column_from_homography(x / w), y / w
    i, j = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    source = image.astype(np.float64).reshape(*image.shape[:2], -1)

    def tap(across: int, down: int) -> F64:
        rows = np.clip(j + down, 0, image.shape[0] - 1)
        return source[rows, np.clip(i + across, 0, image.shape[1] - 1)]

    weights_of = _cubic if cubic and not sheared else _linear
    across, down = weights_of(x - 0.5 - i), weights_of(y - 0.5 - j)
    total = sum(a[..., None] * b[..., None] * tap(k, n) for k, a in across.items() for n, b in down.items())
    result = np.rint(np.asarray(total)).reshape(out.shape)
    if not sheared and not bent:
        beside = (x < -EDGE_PX) | (y < -EDGE_PX) | (x > image.shape[1] + EDGE_PX) | (y > image.shape[0] + EDGE_PX)
        result[beside] = outside
    out[...] = result
    return out


def _linear(t: F64) -> dict[int, F64]:
    return {0: 1 - t, 1: t}


def _cubic(t: F64, a: float = -0.75) -> dict[int, F64]:
    def near(d: F64) -> F64:
        return ((a + 2) * d - (a + 3)) * d * d + 1

    def far(d: F64) -> F64:
        return ((a * d - 5 * a) * d + 8 * a) * d - 4 * a

    return {-1: far(1 + t), 0: near(t), 1: near(1 - t), 2: far(2 - t)}


__all__ = ["exact_resample"]
