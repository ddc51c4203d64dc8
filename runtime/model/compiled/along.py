"""Bilinear samples along a row of rays, of images that lie a homography away: nearly a scale and a shift.

A row of the result is two source rows, blended, and then each pixel's two neighbours, blended, a piece at a time. How
its pieces lie is kept from row to row, as it changes only where panels are tilted.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from runtime.model.compiled.loops import OPTIONS, PIECE, TILE, VECTOR, U, everywhere, loaded
from runtime.records import F32

ANYWHERE_PX = -1e6  # as `near`: an image's edges go on
EDGE_PX = 1e-3  # a place on an image's very edge is within, however it was rounded
DRIFT_PX = 1 / 16  # of a row from the one that its pieces were laid for, at most; their weights follow it
RUN = 480  # numbers of a row whose height in an image counts as a line


@intrinsic
def _blend_piece(typing, row, source, step, weight, slope, out, start):
    """out[start + k] = what lies between row[source + k] and row[source + k + step], `PIECE` numbers at once."""
    signature = types.void(row, types.uint64, types.uint64, types.float32, types.float32, out, types.uint64)

    def generate(context, builder, signature, arguments):
        row, source, step, weight, slope, out, start = arguments
        kinds, fast = signature.args, ["contract"]
        pixels = builder.select(
            builder.icmp_unsigned("==", step, ir.Constant(ir.IntType(64), 3)),
            ir.Constant(VECTOR, [float(k // 3) for k in range(PIECE)]),
            ir.Constant(VECTOR, [float(k) for k in range(PIECE)]),
        )
        here = loaded(context, builder, kinds[0], row, source)
        beside = loaded(context, builder, kinds[0], row, builder.add(source, step))
        grown = builder.fmul(pixels, everywhere(builder, slope), flags=fast)
        share = builder.fadd(grown, everywhere(builder, weight), flags=fast)
        between = builder.fmul(builder.fsub(beside, here, flags=fast), share, flags=fast)
        place = builder.gep(context.make_array(kinds[5])(context, builder, out).data, [start])
        result = builder.fadd(here, between, flags=fast)
        builder.store(result, builder.bitcast(place, ir.PointerType(VECTOR)), align=4)
        return context.get_dummy_value()

    return signature, generate


class Layout(NamedTuple):
    """How the tiles of a row lie in images: kept from row to row, as it changes only where panels are tilted."""

    keys: Any  # (images, tiles, 3) float64: scale, shift and bend that it was laid for
    spans: Any  # (images, tiles, 3) int32: first pixel within the image, first beyond, pieces
    starts: Any  # (images, tiles, pieces) int32, numbers in the tile
    sources: Any  # (images, tiles, pieces) int32, numbers in the image
    weights: Any  # (images, tiles, pieces, 2) float32, of the right neighbour at a piece's first pixel, and its growth
    drift_px: float  # of a row from the one that its pieces were laid for, at most


@njit(**OPTIONS)
def _lay(scale, bend, shift, pixels, width, near, channels, n, tile, layout):  # pragma: no cover
    """Where pixels 0 to `pixels` of a tile lie in a row of `width`, centres at integers: pixel k at shift + scale·k +
    bend·k·(k - pixels + 1)."""
    layout.keys[n, tile, 0], layout.keys[n, tile, 1], layout.keys[n, tile, 2] = scale, shift, bend
    low, high, ends = near - 0.5, width - 0.5 - near, pixels - 1
    longest, count, k, first = PIECE // channels, 0, 0, 0
    grows = scale - 1.0 if abs(scale - 1.0) > 1e-6 else 1e-6
    runs = 1.0 / grows  # pixels until the source is one further beside, but for a parabola's slight bend
    while k < pixels and shift + k * (scale + bend * (k - ends)) < low:
        k += 1
    first = k
    while k < pixels:
        x = shift + k * (scale + bend * (k - ends))
        if x > high:
            break
        within = min(max(x, 0.0), width - 1.0)
        left = min(int(within), max(width - 2, 0))
        share = within - left
        if x < 0.0 or x > width - 1.0:  # an edge goes on
            length = 1
        else:
            length = min(longest, int(((1.0 if grows > 0.0 else 0.0) - share) * runs) + 1)
            length = min(length, int((width - 1.0 - x) / scale) + 1)
        layout.starts[n, tile, count], layout.sources[n, tile, count] = k * channels, left * channels
        local = scale + bend * (2 * k + length - 1 - ends)
        layout.weights[n, tile, count, 0], layout.weights[n, tile, count, 1] = share, local - 1.0
        count, k = count + 1, k + length
    last = min(k, pixels)
    while last > first and shift + (last - 1) * (scale + bend * (last - 1 - ends)) > high:
        last -= 1
    layout.spans[n, tile, 0], layout.spans[n, tile, 1], layout.spans[n, tile, 2] = first, last, count


@njit(**OPTIONS)
def sample(
    image, ring, height, width, near, matrix, v, tile, pixels, channels, n, layout, row, out
):  # pragma: no cover
    """Bilinear samples of an image (ring rows, numbers), whose row r is at r % ring, for the pixels of a
    tile of row v; the pixels that lie within it. matrix (3, 3): the image's pixels from the tile's raster's, centres at
    halves; along a tile a parabola stands for it."""
    a, ends, y = tile * (TILE // channels) + 0.5, max(pixels - 1, 1), v + 0.5
    weight = 1.0 / (matrix[2, 0] * a + matrix[2, 1] * y + matrix[2, 2])
    xa = (matrix[0, 0] * a + matrix[0, 1] * y + matrix[0, 2]) * weight - 0.5
    ya = (matrix[1, 0] * a + matrix[1, 1] * y + matrix[1, 2]) * weight - 0.5
    a += 0.5 * ends
    weight = 1.0 / (matrix[2, 0] * a + matrix[2, 1] * y + matrix[2, 2])
    xm = (matrix[0, 0] * a + matrix[0, 1] * y + matrix[0, 2]) * weight - 0.5
    ym = (matrix[1, 0] * a + matrix[1, 1] * y + matrix[1, 2]) * weight - 0.5
    a += 0.5 * ends
    weight = 1.0 / (matrix[2, 0] * a + matrix[2, 1] * y + matrix[2, 2])
    xb = (matrix[0, 0] * a + matrix[0, 1] * y + matrix[0, 2]) * weight - 0.5
    yb = (matrix[1, 0] * a + matrix[1, 1] * y + matrix[1, 2]) * weight - 0.5
    scale, bend = (xb - xa) / ends, 2.0 * (xa + xb - 2.0 * xm) / (ends * ends)
    low, high = near - 0.5, height - 0.5 - near
    beside = min(ya, yb) < low or max(ya, yb) > high
    if near <= 0.0:  # a tile that an edge cuts goes on as that edge does
        beside = max(ya, yb) < low or min(ya, yb) > high
    if beside or not scale > 0.01:
        return 0, 0
    if abs(bend) * ends < 1e-7:
        bend = 0.0
    shift, grown = xa - layout.keys[n, tile, 1], scale - layout.keys[n, tile, 0]
    bent = abs(bend - layout.keys[n, tile, 2]) * ends * ends
    if not abs(shift) + abs(grown) * ends + bent <= layout.drift_px:  # of the first row, nothing is laid
        _lay(scale, bend, xa, pixels, width, near, channels, n, tile, layout)
        shift, grown = 0.0, 0.0
    first, last, count = layout.spans[n, tile, 0], layout.spans[n, tile, 1], layout.spans[n, tile, 2]
    if count == 0:
        return 0, 0
    source = layout.sources[n, tile, 0]
    numbers = layout.sources[n, tile, count - 1] + PIECE + channels - source
    if ya == yb and ym == ya:
        top = min(int(max(ya, 0.0)), max(height - 2, 0))
        upper, lower, down = U(top % ring), U(min(top + 1, height - 1) % ring), np.float32(min(max(ya - top, 0.0), 1.0))
        begin = U(source)
        for k in range((numbers + PIECE - 1) // PIECE * PIECE):
            x0, x1 = np.float32(image[upper, U(k) + begin]), np.float32(image[lower, U(k) + begin])
            row[U(k)] = x0 + (x1 - x0) * down
    else:
        # Rows are blended run by run: a run ends where the row above changes.
        fall, sag = (yb - ya) / ends, 2.0 * (ya + yb - 2.0 * ym) / (ends * ends)
        at, none, one = 0, np.float32(0), np.float32(1)
        while at < numbers:
            place = (source + at) / channels
            k = first + at / (channels * scale)
            k -= (xa + k * (scale + bend * (k - ends)) - place) / (scale + bend * (2.0 * k - ends))
            here = ya + k * (fall + sag * (k - ends))
            slope = (fall + sag * (2.0 * k - ends)) / (channels * (scale + bend * (2.0 * k - ends)))
            length, top = min(numbers - at, RUN), min(int(max(here, 0.0)), max(height - 2, 0))
            if here < 0.0 or here > height - 1.0:  # an edge goes on, until the row crosses it
                edge = 0.0 if here < 0.0 else height - 1.0
                if (edge - here) * slope > 0.0:
                    length = min(length, int((edge - here) / slope) + 1)
                here, slope = edge, 0.0
            elif slope > 1e-9:
                length = min(length, int((top + 1 - here) / slope) + 1)
            elif slope < -1e-9:
                length = min(length, int((top - here) / slope) + 1)
            upper, lower = U(top % ring), U(min(top + 1, height - 1) % ring)
            weight, grows, begin, to = np.float32(here - top), np.float32(slope), U(at + source), U(at)
            for k in range((length + PIECE - 1) // PIECE * PIECE):  # the next run writes over what is too much
                x0, x1 = np.float32(image[upper, U(k) + begin]), np.float32(image[lower, U(k) + begin])
                row[U(k) + to] = x0 + (x1 - x0) * min(max(weight + grows * np.float32(k), none), one)
            at += length
    along, growth = np.float32(grown / channels), np.float32(grown)
    for piece in range(count):
        start = U(layout.starts[n, tile, U(piece)])
        drifted = np.float32(shift) + along * np.float32(start)
        _blend_piece(
            row,
            U(layout.sources[n, tile, U(piece)] - source),
            U(channels),
            layout.weights[n, tile, U(piece), 0] + drifted,
            layout.weights[n, tile, U(piece), 1] + growth,
            out,
            start,
        )
    return first, last


@njit(**OPTIONS)
def sample_or(
    image, ring, height, width, near, matrix, v, tile, pixels, channels, n, outside, layout, row, out
):  # pragma: no cover
    """As `sample`, and `outside` for the pixels that lie beside the image."""
    first, last = sample(image, ring, height, width, near, matrix, v, tile, pixels, channels, n, layout, row, out)
    for k in range(first * channels):
        out[U(k)] = outside
    for k in range(last * channels, pixels * channels):
        out[U(k)] = outside


def new_layout(images: int, columns: int, channels: int, *, drift_px: float = DRIFT_PX) -> Layout:
    """Of so many images, for rows of so many pixels: nothing is laid yet."""
    spans = (images, -(-columns // (TILE // channels)))
    pieces = (*spans, TILE // channels)
    return Layout(
        np.full((*spans, 3), np.nan), np.zeros((*spans, 3), np.int32), np.zeros(pieces, np.int32),
        np.zeros(pieces, np.int32), np.zeros((*pieces, 2), np.float32), drift_px,
    )  # fmt: skip


def work_row(scale: float) -> F32:
    """(numbers,) to work in, where images are so many times finer than the rays."""
    return np.zeros(int(TILE * max(1.0, scale) * 1.2) + 4 * PIECE, np.float32)


def work_tiles() -> F32:
    """(10, numbers): tiles to work in."""
    return np.zeros((10, TILE + 4 * PIECE), np.float32)
