"""Whole passes over the panels, a few rows at a time, so that nothing between two steps leaves a core's own cache."""

from __future__ import annotations

import numpy as np
from numba import njit

from runtime.model.compiled.along import sample_or
from runtime.model.compiled.loops import OPTIONS, PASS, TILE, U
from runtime.model.targets import SLOPE_FLOOR

WHOLE = 4096  # of a weight, in 16 bits
FLOOR = np.float32(SLOPE_FLOOR)


@njit(**OPTIONS)
def _weigh(wanted, row, begin, count, full, weights):  # pragma: no cover
    """The slope of sin² at wanted phase sums, 1 at its steepest, as a parabola; `SLOPE_FLOOR` at least."""
    slope = np.float32(4) * (np.float32(1) - FLOOR)
    for k in range(count):
        turns = np.float32(wanted[row, U(k) + begin]) * (np.float32(1) / full)
        share = turns - np.floor(turns)
        weights[U(k)] = FLOOR + slope * share * (np.float32(1) - share)


@njit(**OPTIONS)
def _best(left, right, weights, most, count, best):  # pragma: no cover
    """The centre panel that leaves both eyes least, where left and right lack so much."""
    for k in range(count):
        lacks = left[U(k)] * weights[0, U(k)] + right[U(k)] * weights[1, U(k)]
        best[U(k)] = lacks / (weights[0, U(k)] + weights[1, U(k)])
    for k in range(count):
        best[U(k)] = min(max(best[U(k)], np.float32(0)), most)


@njit(**OPTIONS)
def _lacks(
    panels, sizes, near, target, matrices, v, tile, pixels, channels, index, start, layout, row, tiles, out
):  # pragma: no cover
    """What an eye lacks of a target (rows, numbers) on row v of a tile of the centre panel, beside two outer panels
    (rows, numbers) of sizes (rows, pixels). matrices: (2, 3, 3) theirs from the centre's pixels; index: of the first's
    in the layout; out: (numbers,); tiles: (2, numbers), to work in."""
    begin, line = U(tile * (TILE // channels) * channels), U(v)
    for n in range(2):
        height, width = sizes[n, 0], sizes[n, 1]
        sample_or(
            panels[n], height, height, width, near, matrices[n], v, tile, pixels, channels, index + n, start, layout,
            row, tiles[n],
        )  # fmt: skip
    for k in range(pixels * channels):
        out[U(k)] = np.float32(target[line, U(k) + begin]) - (tiles[0, U(k)] + tiles[1, U(k)])


@njit(**PASS)
def correct(
    panels,
    moved,
    sizes,
    near,
    unsure,
    out,
    targets,
    seen,
    back,
    needs,
    size,
    low,
    high,
    shown,
    fade_columns,
    fade_rows,
    first,
    last,
    channels,
    start,
    full,
    step,
    seen_layout,
    back_layout,
    row,
    tiles,
    ring,
):  # pragma: no cover
    """One correction of an outer panel's rows first to last.

    panels: the panel to be corrected and the other one, (rows, numbers) int16, as the eyes see them in the mean; moved:
    what is left of the other for an eye that is off by as much again (used where `unsure`). sizes (3, 2): rows and
    pixels of this panel, of the other, and of the centre one; near: how images end (`along.sample`). out: this panel
    and `size` times what both eyes lack, between low and high; a ray weighs as much as the slope of sin² there
    (`_weigh`). targets: two of (rows, numbers) int16. seen: (2, 2, 3, 3), for each eye, this panel's and the
    other's pixels from the centre's; back: (2, 3, 3) the centre's from this panel's. needs: (rows, 2) first and last of
    the centre's rows that either eye sees a row of this panel through. fade_columns (numbers,), fade_rows (rows,): what
    the residual is multiplied with. seen_layout, back_layout, row, tiles (10, numbers), ring (4, rows, numbers) int16:
    to work in.
    """
    size_of_tile, ring_rows = TILE // channels, ring.shape[1]
    height, width = sizes[2, 0], sizes[2, 1]
    none, one, most, half = np.float32(0), np.float32(1), np.float32(full), np.float32(0.5)
    codes, whole, weights = one / step, np.float32(WHOLE), tiles[6:8]
    outer, done = (panels, (panels[0], moved)), needs[first, 0]
    for q in range(first, last):
        for r in range(max(done, needs[q, 0]), needs[q, 1] + 1):
            line, down = U(r % ring_rows), fade_rows[U(r)]
            for tile in range((width + size_of_tile - 1) // size_of_tile):
                begin = U(tile * size_of_tile * channels)
                pixels = min(size_of_tile, width - tile * size_of_tile)
                count = pixels * channels
                for side in range(2):
                    for part in range(2 if unsure else 1):
                        _lacks(
                            outer[part], sizes, near, targets[side], seen[side], r, tile, pixels, channels, 2 * side,
                            start, seen_layout, row, tiles, tiles[2 + 2 * part + side],
                        )  # fmt: skip
                _weigh(targets[0], U(r), begin, count, most, weights[0])
                _weigh(targets[1], U(r), begin, count, most, weights[1])
                best = tiles[8]
                _best(tiles[2], tiles[3], weights, most, count, best)
                for side in range(2):
                    lacks = tiles[(4 if unsure else 2) + side]
                    for k in range(count):
                        weight = fade_columns[U(k) + begin] * down * weights[U(side), U(k)]
                        ring[U(side), line, U(k) + begin] = np.int16(np.int32((lacks[U(k)] - best[U(k)]) * weight))
                    for k in range(count):
                        ring[U(2 + side), line, U(k) + begin] = np.int16(np.int32(weights[U(side), U(k)] * whole))
        done = max(done, needs[q, 1] + 1)
        for tile in range((sizes[0, 1] + size_of_tile - 1) // size_of_tile):
            begin, at = U(tile * size_of_tile * channels), U(q)
            pixels = min(size_of_tile, sizes[0, 1] - tile * size_of_tile)
            count, lacked, weight = pixels * channels, tiles[3], tiles[5]
            for part in range(2):  # residuals, and what they weigh
                for side in range(2):
                    sample_or(
                        ring[2 * part + side], ring_rows, height, width, near, back[side], q, tile, pixels, channels,
                        side, whole if part else none, back_layout, row, tiles[2 + 2 * part + side],
                    )  # fmt: skip
            for k in range(count):
                lacked[U(k)] = (lacked[U(k)] + tiles[2, U(k)]) * (
                    np.float32(2) * whole / (tiles[4, U(k)] + weight[U(k)])
                )
            if shown:
                for k in range(count):
                    code = min(max(np.float32(panels[0][at, U(k) + begin]) + lacked[U(k)] * size, low), high)
                    out[at, U(k) + begin] = np.int16(np.int32(np.float32(np.int32(code * codes + half)) * step))
            else:
                for k in range(count):
                    code = min(max(np.float32(panels[0][at, U(k) + begin]) + lacked[U(k)] * size, low), high)
                    out[at, U(k) + begin] = np.int16(np.int32(code + (half if code >= none else -half)))


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
    panels,
    sizes,
    near,
    targets,
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
    layout,
    row,
    tiles,
):  # pragma: no cover
    """The centre panel's rows first to last that are best for the outer ones, in 8-bit codes.

    panels: rear and front, (rows, numbers) int16; sizes (3, 2): rows and pixels of both and of the centre panel; seen:
    (2, 2, 3, 3), for each eye, their pixels from the centre's. layer: (rows, pixels) uint32, RGBA, in which they begin
    at pixel u0 of row v0. layout, row, tiles: to work in.
    """
    width, size_of_tile = sizes[2, 1], TILE // channels
    share, half, weights = np.float32(1) / step, np.float32(0.5), tiles[6:8]
    for v in range(first, last):
        for tile in range((width + size_of_tile - 1) // size_of_tile):
            pixels = min(size_of_tile, width - tile * size_of_tile)
            count, begin = pixels * channels, U(tile * size_of_tile * channels)
            for side in range(2):
                _lacks(
                    panels, sizes, near, targets[side], seen[side], v, tile, pixels, channels, 2 * side, start, layout,
                    row, tiles, tiles[2 + side],
                )  # fmt: skip
            _weigh(targets[0], U(v), begin, count, full, weights[0])
            _weigh(targets[1], U(v), begin, count, full, weights[1])
            best = tiles[8]
            _best(tiles[2], tiles[3], weights, full, count, best)
            for k in range(count):
                best[U(k)] = best[U(k)] * share + half
            row_out, to = U(v + v0), U(u0 + tile * size_of_tile)
            if channels == 3:
                for u in range(pixels):
                    k = U(3) * U(u)
                    red, green, blue = np.int32(best[k]), np.int32(best[k + U(1)]), np.int32(best[k + U(2)])
                    layer[row_out, U(u) + to] = _pixel(red, green, blue)
            else:
                for u in range(pixels):
                    code = np.int32(best[U(u)])
                    layer[row_out, U(u) + to] = _pixel(code, code, code)


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
