"""The network's answer that ends within a part of the panels."""

from __future__ import annotations

import numpy as np
from numba import njit

from runtime.model.compiled.loops import PASS


@njit(**PASS)
def fade_codes(codes, weights, start, channels):  # pragma: no cover
    """codes (rows, numbers) towards `start`, as far as weights (rows or 1, pixels) are below 1; in place."""
    one, half, end = np.float32(1), np.float32(0.5), np.float32(start)
    for v in range(codes.shape[0]):
        row = min(v, weights.shape[0] - 1)
        for u in range(weights.shape[1]):
            weight = weights[row, u]
            if weight < one:
                rest = end * (one - weight) + half
                for k in range(u * channels, (u + 1) * channels):
                    codes[v, k] = np.int16(np.int32(np.float32(codes[v, k]) * weight + rest))
