"""Bilinear samples between axis-aligned rasters, a piece of a row at a time.

A row of the result is its two source rows, blended, and then each pixel's two neighbours, blended. Where the scale is
near one, runs of pixels lie the same whole number of pixels beside their source: within such a piece all that is
read is contiguous and the weights grow evenly, so that the processor's widest instructions do the work.
"""

# Indices are unsigned: of signed ones numba asks whether they count from the end, and loops are not vectorised.
# Rows are no slices: each slice is counted twice, across threads.
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import config, njit, types
from numba.extending import intrinsic

from runtime.records import F32, I16

PIECE = 32  # numbers that are blended at once
TILE = 960  # numbers of a row that are done together: they stay in the nearest cache
SLACK = PIECE + 8  # numbers behind a tile that pieces may touch, whatever is there
OPTIONS: Any = {
    "nogil": True,
    "cache": bool(config.CACHE_DIR),  # type: ignore[attr-defined]
    "error_model": "numpy",
    "boundscheck": False,
    "fastmath": {"contract"},
    "forceinline": True,
    "_nrt": False,  # arrays are not counted, across threads: a tenth of a microsecond for each mention
}
PASS: Any = {**OPTIONS, "forceinline": False}  # of functions that are called from outside
EDGE_PX = 1e-3  # a place on an image's very edge is within
CHANNELS = 4  # of a picture's pixel, RGBA
U = np.uint64

_VECTOR = ir.VectorType(ir.FloatType(), PIECE)


class Samplings(NamedTuple):
    """Where the pixels of a result's raster are in images, a row here for each image: rows, and pieces of columns in
    numbers (pixels times channels)."""

    rows: Any  # (n, h) int32, the upper of two source rows; -1: outside
    row_weights: Any  # (n, h) float32, of the lower one
    starts: Any  # (n, pieces) int32, in the result
    sources: Any  # (n, pieces) int32, in the image, which begins with its first pixel repeated
    weights: Any  # (n, pieces) float32, of the right neighbour, at a piece's first pixel
    tiles: Any  # (n, tiles + 1) int32, each tile's first piece
    slopes: Any  # (n,) float32: by how much the weight grows from pixel to pixel
    inside: Any  # (n, 2) int32, in the result: first within the image, and first beyond


def samplings(matrices: Any, *, height: int, width: int, sizes: Any, channels: int) -> Samplings:
    """Where a result's (height, width) pixels are in images of (n, 2) `sizes`, height and width.

    matrices: (n, 3, 3), each a scale and a shift: image from result, pixel centres at half-integers.
    """
    n, tiles = len(matrices), -(-width // (TILE // channels))
    made = Samplings(
        np.empty((n, height), np.int32),
        np.zeros((n, height), np.float32),
        np.empty((n, width), np.int32),
        np.empty((n, width), np.int32),
        np.empty((n, width), np.float32),
        np.empty((n, tiles + 1), np.int32),
        np.empty(n, np.float32),
        np.zeros((n, 2), np.int32),
    )
    _lay(np.asarray(matrices, np.float64), np.asarray(sizes, np.int64), channels, made)
    return made


@njit(**OPTIONS)
def _lay(matrices, sizes, channels, made):  # pragma: no cover
    height, width = made.rows.shape[1], made.starts.shape[1]
    tile_px = TILE // channels
    for n in range(matrices.shape[0]):
        matrix, image_height, image_width = matrices[n], sizes[n, 0], sizes[n, 1]
        made.slopes[n] = matrix[0, 0] - 1
        for v in range(height):
            y = matrix[1, 1] * (v + 0.5) + matrix[1, 2]
            made.rows[n, v] = -1
            if -EDGE_PX <= y <= image_height + EDGE_PX:
                top = max(0, min(int(np.floor(y - 0.5)), image_height - 2))
                made.rows[n, v] = top
                made.row_weights[n, v] = max(0.0, min(y - 0.5 - top, 1.0)) if image_height > 1 else 0.0
        count, began, lag = 0, -1, 0
        for tile in range(made.tiles.shape[1] - 1):
            made.tiles[n, tile] = count
            began = -1
            for u in range(tile * tile_px, min(width, (tile + 1) * tile_px)):
                x = matrix[0, 0] * (u + 0.5) + matrix[0, 2]
                if not -EDGE_PX <= x <= image_width + EDGE_PX:
                    began = -1
                    continue
                if made.inside[n, 1] == 0:
                    made.inside[n, 0] = u * channels
                made.inside[n, 1] = (u + 1) * channels
                left = max(-1, min(int(np.floor(x - 0.5)), image_width - 1))
                if began >= 0 and left - u == lag and (u + 1 - began) * channels <= PIECE:
                    continue
                made.starts[n, count], made.sources[n, count] = u * channels, (left + 1) * channels
                made.weights[n, count] = x - 0.5 - left
                began, lag = u, left - u
                count += 1
        made.tiles[n, made.tiles.shape[1] - 1] = count


def _loaded(context, builder, kind, array, index):
    """`PIECE` numbers of an array from an index on, as floats."""
    number = context.get_data_type(kind.dtype)
    vector = ir.VectorType(number, PIECE)
    place = builder.gep(context.make_array(kind)(context, builder, array).data, [index])
    read = builder.load(builder.bitcast(place, ir.PointerType(vector)), align=kind.dtype.bitwidth // 8)
    return read if isinstance(number, ir.FloatType) else builder.sitofp(read, _VECTOR)


def _everywhere(builder, value):
    empty, first = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    mask = ir.Constant(ir.VectorType(ir.IntType(32), PIECE), [0] * PIECE)
    return builder.shuffle_vector(builder.insert_element(empty, value, first), empty, mask)


@intrinsic
def _take_piece(typing, row, source, step, weight, slope, wanted, at, out, start):
    """out[start + k] = wanted[at + k] - what lies between row[source + k] and row[source + k + step], `PIECE`
    numbers at once: numba asks at every piece whether the arrays overlap, which takes longer than the work."""
    signature = types.void(
        row, types.uint64, types.uint64, types.float32, types.float32, wanted, types.uint64, out, types.uint64
    )

    def generate(context, builder, signature, arguments):
        row, source, step, weight, slope, wanted, at, out, start = arguments
        kinds = signature.args
        pixels = builder.select(
            builder.icmp_unsigned("==", step, ir.Constant(ir.IntType(64), 3)),
            ir.Constant(_VECTOR, [float(k // 3) for k in range(PIECE)]),
            ir.Constant(_VECTOR, [float(k) for k in range(PIECE)]),
        )
        fast = ["contract"]
        here = _loaded(context, builder, kinds[0], row, source)
        beside = _loaded(context, builder, kinds[0], row, builder.add(source, step))
        grown = builder.fmul(pixels, _everywhere(builder, slope), flags=fast)
        share = builder.fadd(grown, _everywhere(builder, weight), flags=fast)
        between = builder.fmul(builder.fsub(beside, here, flags=fast), share, flags=fast)
        left = builder.fsub(_loaded(context, builder, kinds[5], wanted, at), here, flags=fast)
        place = builder.gep(context.make_array(kinds[7])(context, builder, out).data, [start])
        result = builder.fsub(left, between, flags=fast)
        builder.store(result, builder.bitcast(place, ir.PointerType(_VECTOR)), align=4)
        return context.get_dummy_value()

    return signature, generate


@njit(**OPTIONS)
def lack(
    wanted, wanted_row, wanted_at, image, first_row, image_width, n, v, tile, count, at, channels, outside, row, out
):  # pragma: no cover
    """What an image lacks of what is wanted, on row v of a tile of `count` numbers: into out (TILE + SLACK,) float32.

    wanted: (rows, numbers), from number wanted_at of its row on. image: (rows, numbers) from source row `first_row` on,
    of which `image_width` numbers in a row count, by the n-th of the `Samplings` at; row: `work_row`.
    """
    top, size = at.rows[n, v], TILE // channels * channels
    first, last = at.tiles[n, tile], at.tiles[n, tile + 1]
    line, begin = U(wanted_row), U(wanted_at)
    if top < 0 or first == last:
        for k in range(count):
            out[U(k)] = np.float32(wanted[line, U(k) + begin]) - outside
        return
    low = at.sources[n, first]
    # The last piece reads as far as a whole one does, and a pixel more.
    high = min(at.sources[n, last - 1] + PIECE // channels * channels + channels, image_width + 2 * channels)
    upper = U(top - first_row)
    lower = min(upper + U(1), U(image.shape[0] - 1))
    weight = at.row_weights[n, v]
    rest = np.float32(1) - weight
    a, b = max(low, channels), min(high, image_width + channels)
    to, source = U(a - low), U(a - channels)
    for k in range((b - a + PIECE - 1) // PIECE * PIECE):  # whole pieces: a rest would be done number by number
        above, below = np.float32(image[upper, U(k) + source]), np.float32(image[lower, U(k) + source])
        row[U(k) + to] = above * rest + below * weight
    for k in range(low, a):
        row[U(k - low)] = row[U(k - low + channels)]
    for k in range(b, high):
        row[U(k - low)] = row[U(k - low - channels)]
    numbers = line * U(wanted.shape[1]) + begin
    for piece in range(first, last):
        start = U(at.starts[n, U(piece)] - tile * size)
        _take_piece(
            row,
            U(at.sources[n, U(piece)] - low),
            U(channels),
            at.weights[n, U(piece)],
            at.slopes[n],
            wanted,
            numbers + start,
            out,
            start,
        )
    for k in range(min(count, at.inside[n, 0] - tile * size)):
        out[U(k)] = np.float32(wanted[line, U(k) + begin]) - outside
    for k in range(max(0, at.inside[n, 1] - tile * size), count):
        out[U(k)] = np.float32(wanted[line, U(k) + begin]) - outside


def work_row(scale: float) -> F32:
    """(numbers,) to work in: what a tile reads of an image so many times finer."""
    return np.zeros(int(TILE * max(1.0, scale)) + 4 * SLACK, np.float32)


def work_tiles() -> F32:
    """(8, numbers): tiles to work in, the second all zeros."""
    return np.zeros((8, TILE + SLACK), np.float32)


def numbers_of(image: I16) -> I16:
    """(rows, numbers): the buffer that an image begins, with what is behind it."""
    parent = image.base
    assert isinstance(parent, np.ndarray)
    return parent.reshape(parent.shape[0], -1)
