"""The phase sums that a picture asks for, on every pixel and on every second, from one look at it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from runtime.model import wanted as plain
from runtime.model.compiled.loops import CHANNELS, PASS, U, numbers_of
from runtime.model.wanted import Pictures
from runtime.records import I16
from runtime.support.threads import at_once, shares

MARGIN = CHANNELS  # numbers: a pixel to either side


@njit(**PASS)
def want(
    picture, v0, u0, height, width, table, strength, wanted, halved, channels, first, last, row, codes, pairs
):  # pragma: no cover
    """Phase sums of rows first to last of a box of a picture (rows, numbers) uint8 RGBA, into `wanted` (rows, numbers)
    int16, and those of blocks of two by two pixels into `halved`, unless that has no rows.

    v0, u0, height, width: the box; first and last are even, but for the box's end. It is sharpened by a separable
    [-strength, 1 + 2·strength, -strength], mirrored about the box's outermost pixels. row (numbers + 2·MARGIN,)
    float32, codes (2, numbers) uint8, pairs (numbers,) uint16: to work in.
    """
    numbers, begin, margin = width * CHANNELS, U(u0) * U(CHANNELS), U(MARGIN)
    middle, beside = np.float32(1 + 2 * strength), np.float32(strength)
    none, most = np.float32(0), np.float32(255)
    for v in range(first, last):
        above, below = (v - 1 if v > 0 else min(1, height - 1)), (v + 1 if v + 1 < height else max(height - 2, 0))
        here, up, down, odd = U(v + v0), U(above + v0), U(below + v0), U(v & 1)
        for k in range(numbers):
            at = U(k) + begin
            outer = np.float32(picture[up, at]) + np.float32(picture[down, at])
            row[U(k) + margin] = middle * np.float32(picture[here, at]) - beside * outer
        for k in range(MARGIN):
            row[U(k)] = row[U(k) + (U(2) if width > 1 else U(1)) * margin]
            row[U(numbers + k) + margin] = row[U(numbers + k) - (margin if width > 1 else U(0))]
        for k in range(numbers):
            sharp = middle * row[U(k) + margin] - beside * (row[U(k)] + row[U(k) + U(2) * margin])
            codes[odd, U(k)] = np.uint8(np.int32(np.rint(min(max(sharp, none), most))))
        if channels == 3:
            for u in range(width):
                at, to = U(u) * U(CHANNELS), U(u) * U(3)
                wanted[U(v), to] = table[codes[odd, at]]
                wanted[U(v), to + U(1)] = table[codes[odd, at + U(1)]]
                wanted[U(v), to + U(2)] = table[codes[odd, at + U(2)]]
        else:
            for u in range(width):
                wanted[U(v), U(u)] = table[codes[odd, U(u) * U(CHANNELS)]]
        if halved.shape[0] and odd:
            for k in range(numbers):
                pairs[U(k)] = np.uint16(codes[0, U(k)]) + np.uint16(codes[1, U(k)])
            for k in range(numbers - CHANNELS):
                pairs[U(k)] = (pairs[U(k)] + pairs[U(k) + U(CHANNELS)] + np.uint16(2)) >> np.uint16(2)
            line = U(v >> 1)
            if channels == 3:
                for u in range(width >> 1):
                    at, to = U(u) * U(2 * CHANNELS), U(u) * U(3)
                    halved[line, to] = table[pairs[at]]
                    halved[line, to + U(1)] = table[pairs[at + U(1)]]
                    halved[line, to + U(2)] = table[pairs[at + U(2)]]
            else:
                for u in range(width >> 1):
                    halved[line, U(u)] = table[pairs[U(u) * U(2 * CHANNELS)]]


def fill_targets(pictures: Pictures, pairs: Sequence[Sequence[I16]], *, threads: int) -> None:
    """As `runtime.model.wanted.fill_targets`; other sizes than every pixel and every second are left to it."""
    height, width = pictures.box.height_px, pictures.box.width_px
    full, *rest = pairs
    fits = full[0].shape[:2] == (height, width) and all(
        (2 * half[0].shape[0], 2 * half[0].shape[1]) == (height, width) for half in rest
    )
    if not fits or len(rest) > 1:
        plain.fill_targets(pictures, pairs)
        return
    halves = rest[0] if rest else [np.empty((0, 0), np.int16) for _ in full]
    sources = [np.ascontiguousarray(array).reshape(array.shape[0], -1) for array in pictures.arrays]
    place = pictures.box.v0, pictures.box.u0, height, width, pictures.table.reshape(-1), pictures.emphasis
    numbers = width * CHANNELS

    def work(part: tuple[int, int]) -> None:
        first, last = part[0] // 2 * 2, height if part[1] == height else part[1] // 2 * 2
        row, codes = np.zeros(numbers + 2 * MARGIN, np.float32), np.zeros((2, numbers), np.uint8)
        pairs_of_codes = np.zeros(numbers, np.uint16)
        for source, wanted, half in zip(sources, full, halves, strict=True):
            images = numbers_of(wanted), numbers_of(half) if rest else half
            want(source, *place, *images, pictures.channels, first, last, row, codes, pairs_of_codes)

    at_once(work, shares(height, threads))
