"""A panel twice as fine, by cubic samples."""

from __future__ import annotations

import numpy as np
from numba import njit

from runtime.model.compiled.loops import PASS, U

# Keys' kernel, a = -0.75, for pixels a quarter beyond the second of four; mirrored for three quarters.
NEAR, FAR = (-0.10546875, 0.87890625, 0.26171875, -0.03515625), (-0.03515625, 0.26171875, 0.87890625, -0.10546875)


@njit(**PASS)
def enlarge(coarse, height, width, channels, out, first, last, shown, most, step, row, even, odd):  # pragma: no cover
    """Rows first to last of out (rows, numbers) int16, from 0 to most, whole steps where `shown`.

    coarse (rows, numbers) int16: `height` rows of `width` pixels of `channels` numbers, whose edges go on.
    row ((width + 4)·channels,), even, odd (width·channels,) float32: to work in.
    """
    numbers, c = width * channels, U(channels)
    low, high, half = np.float32(0), np.float32(most), np.float32(0.5)
    unit, per_unit = (np.float32(step), np.float32(1) / np.float32(step)) if shown else (np.float32(1), np.float32(1))
    for v in range(first, last):
        weights = NEAR if v & 1 else FAR
        begin = (v >> 1) - (1 if v & 1 else 2)
        a, b = U(min(max(begin, 0), height - 1)), U(min(max(begin + 1, 0), height - 1))
        d, e = U(min(max(begin + 2, 0), height - 1)), U(min(max(begin + 3, 0), height - 1))
        w0, w1, w2, w3 = np.float32(weights[0]), np.float32(weights[1]), np.float32(weights[2]), np.float32(weights[3])
        for k in range(numbers):
            upper = np.float32(coarse[a, U(k)]) * w0 + np.float32(coarse[b, U(k)]) * w1
            row[U(k) + U(2) * c] = upper + np.float32(coarse[d, U(k)]) * w2 + np.float32(coarse[e, U(k)]) * w3
        for k in range(channels):
            row[U(k)] = row[U(k) + c] = row[U(k) + U(2) * c]
            row[U(k + numbers) + U(2) * c] = row[U(k + numbers) + U(3) * c] = row[U(k + numbers) + c]
        w0, w1, w2, w3 = np.float32(NEAR[0]), np.float32(NEAR[1]), np.float32(NEAR[2]), np.float32(NEAR[3])
        for k in range(numbers):
            one, two, three = row[U(k) + c], row[U(k) + U(2) * c], row[U(k) + U(3) * c]
            even[U(k)] = row[U(k)] * w3 + one * w2 + two * w1 + three * w0
            odd[U(k)] = one * w0 + two * w1 + three * w2 + row[U(k) + U(4) * c] * w3
        for k in range(numbers):
            even[U(k)] = min(max(np.floor(even[U(k)] * per_unit + half) * unit, low), high)
            odd[U(k)] = min(max(np.floor(odd[U(k)] * per_unit + half) * unit, low), high)
        line = U(v)
        if channels == 3:
            for u in range(width):
                at, to = U(u) * U(3), U(u) * U(6)
                out[line, to] = np.int16(even[at])
                out[line, to + U(1)] = np.int16(even[at + U(1)])
                out[line, to + U(2)] = np.int16(even[at + U(2)])
                out[line, to + U(3)] = np.int16(odd[at])
                out[line, to + U(4)] = np.int16(odd[at + U(1)])
                out[line, to + U(5)] = np.int16(odd[at + U(2)])
        else:
            for u in range(width):
                out[line, U(u) * U(2)], out[line, U(u) * U(2) + U(1)] = np.int16(even[U(u)]), np.int16(odd[U(u)])
