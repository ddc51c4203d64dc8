"""Whole passes over the panels, a few rows at a time, so that nothing between two steps leaves a core's own cache."""

from __future__ import annotations

import numpy as np
from numba import njit

from runtime.model.compiled.sampling import OPTIONS, PASS, TILE, U, lack

STRIP_ROWS = 16  # of a panel, that are corrected together
WHOLE = 4096  # of a weight, in 16 bits


@njit(**OPTIONS)
def _weigh(wanted, row, begin, count, floor, full, weights):  # pragma: no cover
    """The slope of sin² at wanted phase sums, 1 at its steepest, as a parabola; floor at least."""
    slope = np.float32(4) * (np.float32(1) - floor)
    for k in range(count):
        turns = np.float32(wanted[row, U(k) + begin]) * (np.float32(1) / full)
        share = turns - np.floor(turns)
        weights[U(k)] = floor + slope * share * (np.float32(1) - share)


@njit(**OPTIONS)
def _best(left, right, weights, weighed, most, count, best):  # pragma: no cover
    """The centre panel that leaves both eyes least."""
    none, half = np.float32(0), np.float32(0.5)
    if weighed:
        for k in range(count):
            lacks = left[U(k)] * weights[0, U(k)] + right[U(k)] * weights[1, U(k)]
            best[U(k)] = lacks / (weights[0, U(k)] + weights[1, U(k)])
        for k in range(count):
            best[U(k)] = min(max(best[U(k)], none), most)
    else:
        for k in range(count):
            best[U(k)] = min(max((left[U(k)] + right[U(k)]) * half, none), most)


@njit(**OPTIONS)
def _rows_before(back, side, first, last, height):  # pragma: no cover
    """The centre panel's rows, first and beyond, that an eye sees a panel's rows first to last through; none: 0, 0."""
    begin, end = height, 0
    for v in range(first, last):
        if back.rows[side, v] >= 0:
            begin, end = min(begin, back.rows[side, v]), max(end, back.rows[side, v] + 2)
    return (begin, min(end, height)) if begin < end else (0, 0)


@njit(**PASS)
def correct(
    this,
    other,
    other_moved,
    this_width,
    other_width,
    this_first,
    unsure,
    out,
    left_wanted,
    right_wanted,
    seen,
    back,
    size,
    floor,
    low,
    high,
    shown,
    fade_columns,
    fade_rows,
    share,
    shares,
    channels,
    start,
    full,
    step,
    row,
    scratch,
    residual,
):  # pragma: no cover
    """One correction of every `shares`-th strip of a panel's rows, from strip `share` on.

    this, other: the panel to be corrected and the other one, (rows, numbers) int16, of which so many numbers a row
    count, as the eyes see them in the mean; other_moved: what is left of the other for an eye that is off by as much
    again (used where `unsure`). out: `this` and `size` times what both eyes lack, between low and high; a
    ray weighs as much as the slope of sin² there, and `floor` at least. wanted: (rows,
    numbers) int16. seen: `Samplings` of the rear panel on the centre one for the left and the right eye, and of the
    front one; this_first: the first of this panel's. back: of the centre panel on this, for each eye. fade_columns
    (numbers,), fade_rows (rows,): what the residual is multiplied with. residual: (4, rows, numbers) int16, row:
    `work_row`, scratch: `work_tiles`, to work in.
    """
    height, width = back.rows.shape[1], back.starts.shape[1] * channels
    centre_height, centre_width = seen.rows.shape[1], seen.starts.shape[1] * channels
    size_of_tile = TILE // channels * channels
    part, even, left, right, moved = scratch[0:1], scratch[1:2], scratch[2], scratch[3], scratch[4:6]
    none, one, most, half = np.float32(0), np.float32(1), np.float32(full), np.float32(0.5)
    codes, weight_whole, weights = one / step, np.float32(WHOLE), scratch[6:8]
    for k in range(TILE):
        weights[0, U(k)] = one
        weights[1, U(k)] = one
    for v0 in range(share * STRIP_ROWS, height, shares * STRIP_ROWS):
        v1 = min(v0 + STRIP_ROWS, height)
        # Each eye sees the strip before rows of its own: those of a head that is rolled lie far apart.
        l0, l1 = _rows_before(back, 0, v0, v1, centre_height)
        r0, r1 = _rows_before(back, 1, v0, v1, centre_height)
        for r in range(min(l0, r0), max(l1, r1)):
            for_left, for_right = l0 <= r < l1, r0 <= r < r1
            if not (for_left or for_right):
                continue
            for tile in range(seen.tiles.shape[1] - 1):
                count = min(size_of_tile, centre_width - tile * size_of_tile)
                at = tile * size_of_tile
                for side in range(2):
                    wanted, lacks = (left_wanted, left) if side == 0 else (right_wanted, right)
                    a, b = this_first + side, 2 - this_first + side
                    lack(wanted, r, at, this, 0, this_width, a, r, tile, count, seen, channels, start, row, part[0])
                    lack(part, 0, 0, other, 0, other_width, b, r, tile, count, seen, channels, start, row, lacks)
                    if unsure:
                        lack(
                            part,
                            0,
                            0,
                            other_moved,
                            0,
                            other_width,
                            b,
                            r,
                            tile,
                            count,
                            seen,
                            channels,
                            start,
                            row,
                            moved[side],
                        )
                begin, down = U(at), fade_rows[U(r)]
                if floor < one:
                    _weigh(left_wanted, U(r), begin, count, floor, most, weights[0])
                    _weigh(right_wanted, U(r), begin, count, floor, most, weights[1])
                _best(left, right, weights, floor < one, most, count, part[0])
                lefts, rights = (moved[0], moved[1]) if unsure else (left, right)
                for side in range(2):
                    if not (for_left if side == 0 else for_right):
                        continue
                    lacks, kept, line = (
                        (lefts, residual[0], U(r - l0)) if side == 0 else (rights, residual[1], U(r - r0))
                    )
                    for k in range(count):
                        weight = fade_columns[U(k) + begin] * down * weights[U(side), U(k)]
                        kept[line, U(k) + begin] = np.int16(np.int32((lacks[U(k)] - part[0, U(k)]) * weight))
                    if floor < one:
                        kept = residual[2] if side == 0 else residual[3]
                        for k in range(count):
                            kept[line, U(k) + begin] = np.int16(np.int32(weights[U(side), U(k)] * weight_whole))
        for v in range(v0, v1):
            for tile in range(back.tiles.shape[1] - 1):
                count = min(size_of_tile, width - tile * size_of_tile)
                begin, down = U(tile * size_of_tile), U(v)
                lack(even, 0, 0, residual[0], l0, centre_width, 0, v, tile, count, back, channels, none, row, part[0])
                lack(part, 0, 0, residual[1], r0, centre_width, 1, v, tile, count, back, channels, none, row, left)
                if floor < one:
                    for side in range(2):
                        before, sums, seen_weights, begun = (
                            (even, part[0], residual[2], l0) if side == 0 else (part, right, residual[3], r0)
                        )
                        tile_of = (centre_width, side, v, tile, count, back, channels, weight_whole, row, sums)
                        lack(before, 0, 0, seen_weights, begun, *tile_of)
                    for k in range(count):
                        left[U(k)] *= np.float32(-2) * weight_whole / right[U(k)]
                if shown:
                    for k in range(count):
                        code = min(max(np.float32(this[down, U(k) + begin]) - left[U(k)] * size, low), high)
                        shown_code = np.int32(code * codes + half)
                        out[down, U(k) + begin] = np.int16(np.int32(np.float32(shown_code) * step))
                else:
                    for k in range(count):
                        code = min(max(np.float32(this[down, U(k) + begin]) - left[U(k)] * size, low), high)
                        out[down, U(k) + begin] = np.int16(np.int32(code + (half if code >= none else -half)))


@njit(**PASS)
def blur(
    image, weights_down, weights_across, before, gain, high, shown, out, height, width, first, last, channels, step, acc
):  # pragma: no cover
    """Rows first to last of `before` and `gain` times what a blurred image (rows, numbers) int16 differs from it.

    weights: (taps,) float32 from the middle outwards, an odd number of them, for rows and for columns; beside the
    image's (height, width in numbers) its edge is repeated. out: (rows, numbers) int16, between 0 and high where that
    is not 0, in whole steps where it is shown. acc: (2, numbers) float32, with room for the taps beside a row, to work
    in.
    """
    pad = (weights_across.shape[0] - 1) * channels
    half, none = np.float32(0.5), np.float32(0)
    codes = np.float32(1) / step
    for v in range(first, last):
        middle = weights_down[0]
        for tap in range(1, weights_down.shape[0], 2):
            w1, w2 = weights_down[tap], weights_down[tap + 1]
            a, b = U(max(v - tap, 0)), U(min(v + tap, height - 1))
            c, d = U(max(v - tap - 1, 0)), U(min(v + tap + 1, height - 1))
            if tap == 1:
                for k in range(width):
                    near = np.float32(image[a, U(k)]) + np.float32(image[b, U(k)])
                    far = np.float32(image[c, U(k)]) + np.float32(image[d, U(k)])
                    acc[0, U(k + pad)] = np.float32(image[U(v), U(k)]) * middle + near * w1 + far * w2
            else:
                for k in range(width):
                    near = np.float32(image[a, U(k)]) + np.float32(image[b, U(k)])
                    far = np.float32(image[c, U(k)]) + np.float32(image[d, U(k)])
                    acc[0, U(k + pad)] += near * w1 + far * w2
        for k in range(pad):
            acc[0, U(k)] = acc[0, U(pad + k % channels)]
            acc[0, U(pad + width + k)] = acc[0, U(pad + width - channels + k % channels)]
        middle = weights_across[0]
        for tap in range(1, weights_across.shape[0], 2):
            w1, w2 = weights_across[tap], weights_across[tap + 1]
            a, b = U(pad - tap * channels), U(pad + tap * channels)
            c, d = U(pad - (tap + 1) * channels), U(pad + (tap + 1) * channels)
            if tap == 1:
                for k in range(width):
                    near, far = acc[0, U(k) + a] + acc[0, U(k) + b], acc[0, U(k) + c] + acc[0, U(k) + d]
                    acc[1, U(k)] = acc[0, U(k) + U(pad)] * middle + near * w1 + far * w2
            else:
                for k in range(width):
                    near, far = acc[0, U(k) + a] + acc[0, U(k) + b], acc[0, U(k) + c] + acc[0, U(k) + d]
                    acc[1, U(k)] += near * w1 + far * w2
        line = U(v)
        if high == none:
            for k in range(width):
                blurred = acc[1, U(k)]
                out[line, U(k)] = np.int16(np.int32(blurred + (half if blurred >= none else -half)))
        elif shown:
            for k in range(width):
                was = np.float32(before[line, U(k)])
                code = min(max(was + (acc[1, U(k)] - was) * gain, none), high)
                out[line, U(k)] = np.int16(np.int32(np.float32(np.int32(code * codes + half)) * step))
        else:
            for k in range(width):
                was = np.float32(before[line, U(k)])
                code = min(max(was + (acc[1, U(k)] - was) * gain, none), high)
                out[line, U(k)] = np.int16(np.int32(code + half))


@njit(**PASS)
def close_centre(
    rear,
    front,
    rear_width,
    front_width,
    left_wanted,
    right_wanted,
    seen,
    layer,
    v0,
    u0,
    first,
    last,
    channels,
    start,
    full,
    step,
    floor,
    row,
    scratch,
):  # pragma: no cover
    """The centre panel's rows first to last that are best for the outer ones, in 8-bit codes.

    layer: (rows, pixels) uint32, RGBA, in which they begin at pixel u0 of row v0.
    """
    width = seen.starts.shape[1] * channels
    size_of_tile = TILE // channels * channels
    part, left, right = scratch[0:1], scratch[2], scratch[3]
    share, half, weights = np.float32(1) / step, np.float32(0.5), scratch[6:8]
    for v in range(first, last):
        for tile in range(seen.tiles.shape[1] - 1):
            at = tile * size_of_tile
            count = min(size_of_tile, width - at)
            for side in range(2):
                wanted, lacks = (left_wanted, left) if side == 0 else (right_wanted, right)
                lack(wanted, v, at, rear, 0, rear_width, side, v, tile, count, seen, channels, start, row, part[0])
                lack(part, 0, 0, front, 0, front_width, side + 2, v, tile, count, seen, channels, start, row, lacks)
            if floor < np.float32(1):
                _weigh(left_wanted, U(v), U(at), count, floor, full, weights[0])
                _weigh(right_wanted, U(v), U(at), count, floor, full, weights[1])
            _best(left, right, weights, floor < np.float32(1), full, count, part[0])
            for k in range(count):
                left[U(k)] = part[0, U(k)] * share + half
            row_out, begin = U(v + v0), U(u0 + at // channels)
            if channels == 3:
                for u in range(count // 3):
                    k = U(3) * U(u)
                    red, green, blue = np.int32(left[k]), np.int32(left[k + U(1)]), np.int32(left[k + U(2)])
                    layer[row_out, U(u) + begin] = _pixel(red, green, blue)
            else:
                for u in range(count):
                    code = np.int32(left[U(u)])
                    layer[row_out, U(u) + begin] = _pixel(code, code, code)


@njit(**OPTIONS)
def _pixel(red, green, blue):  # pragma: no cover
    """Opaque RGBA of three 8-bit codes, in one number."""
    low = np.uint32(red) | np.uint32(green) << np.uint32(8)
    return np.uint32(low | np.uint32(blue) << np.uint32(16) | np.uint32(0xFF000000))


@njit(**PASS)
def show(panel, layer, v0, u0, width, first, last, channels, bits):  # pragma: no cover
    """An outer panel's rows first to last, (rows, numbers) int16 of so many bits beyond 8, into a layer as above."""
    half = np.int32(1 << (bits - 1))
    for v in range(first, last):
        line, row, begin = U(v), U(v + v0), U(u0)
        if channels == 3:
            for u in range(width):
                at = U(3) * U(u)
                red, green = (
                    (np.int32(panel[line, at]) + half) >> bits,
                    (np.int32(panel[line, at + U(1)]) + half) >> bits,
                )
                layer[row, U(u) + begin] = _pixel(red, green, (np.int32(panel[line, at + U(2)]) + half) >> bits)
        else:
            for u in range(width):
                code = (np.int32(panel[line, U(u)]) + half) >> bits
                layer[row, U(u) + begin] = _pixel(code, code, code)
