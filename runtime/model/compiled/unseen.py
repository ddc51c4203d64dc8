"""What pictures do not show of a raster, row by row."""

from __future__ import annotations

from numba import njit

from runtime.model.compiled.loops import PASS


@njit(**PASS)
def extrapolate_rows(left, right, left_first, left_last, right_first, right_last, v0, start, stop):  # pragma: no cover
    """As `runtime.model.unseen.extrapolate_border`, of rows from v0 on that a picture shows a part of: RGBA (rows,
    pixels) uint32, of which pixels start to stop are drawn."""
    for row in range(left_first.shape[0]):
        a, b, c, d = left_first[row], left_last[row], right_first[row], right_last[row]
        if b <= a and d <= c:
            continue
        v = row + v0
        for k in range(c, d):
            if k < a or k >= b:
                left[v, k] = right[v, k]
        for k in range(a, b):
            if k < c or k >= d:
                right[v, k] = left[v, k]
        by_left, by_right = b > a and (d <= c or a <= c), b > a and (d <= c or b >= d)
        begin, low = (a, left[v, a]) if by_left else (c, right[v, c])
        end, high = (b, left[v, b - 1]) if by_right else (d, right[v, d - 1])
        for k in range(start, begin):
            left[v, k], right[v, k] = low, low
        for k in range(end, stop):
            left[v, k], right[v, k] = high, high
