"""A picture on a raster by cubic samples, in two passes: down its columns, then along its rows.

A row of the raster is a straight line in the picture. What that line crosses of each of the picture's columns is
sampled first, and what was found then at the raster's pixels (Catmull and Smith, SIGGRAPH 1980): eight numbers of the
picture for one of the raster instead of sixteen, and all of them contiguous.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from runtime.model.compiled.sampling import OPTIONS, PASS, U
from runtime.records import F64, U8

PIECE = 16  # pixels that are sampled at once
CUBIC = np.float32(-0.75)  # of the kernel, as OpenCV's
TAPS = 4
RISE_MOST = (
    0.25  # of a row of the raster in the picture, rows for a column: steeper ones lose sharpness in the first pass
)
MARGIN_PX = 2048  # of a picture that a row may reach beside it

_VECTOR = ir.VectorType(ir.FloatType(), PIECE)


@intrinsic
def _weigh_piece(typing, line, source, weights, start, stride, out):
    """out[start + k] = sum over t of weights[t·stride + start + k]·line[source + k + t], for `PIECE` pixels at once."""
    signature = types.void(line, types.uint64, weights, types.uint64, types.uint64, out)

    def generate(context, builder, signature, arguments):
        line, source, weights, start, stride, out = arguments

        def place(array, at, index):
            data = context.make_array(signature.args[at])(context, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), ir.PointerType(_VECTOR))

        total = None
        for tap in range(TAPS):
            number = ir.Constant(ir.IntType(64), tap)
            read = builder.load(place(line, 0, builder.add(source, number)), align=4)
            weight = builder.load(place(weights, 2, builder.add(start, builder.mul(stride, number))), align=4)
            product = builder.fmul(read, weight, flags=["contract"])
            total = product if total is None else builder.fadd(total, product, flags=["contract"])
        builder.store(total, place(out, 5, start), align=4)
        return context.get_dummy_value()

    return signature, generate


@njit(**OPTIONS)
def _cubic_weights(shares, weights, begin, end):  # pragma: no cover
    """(4, n) weights of four neighbours for a share of the way from the second to the third."""
    a = CUBIC
    one, two, three, five = np.float32(1), np.float32(2), np.float32(3), np.float32(5)
    four, eight = np.float32(4), np.float32(8)
    for k in range(begin, end):
        t = shares[U(k)]
        before = t + one
        weights[0, U(k)] = ((a * before - five * a) * before + eight * a) * before - four * a
        weights[1, U(k)] = ((a + two) * t - (a + three)) * t * t + one
        rest = one - t
        weights[2, U(k)] = ((a + two) * rest - (a + three)) * rest * rest + one
    for k in range(begin, end):
        weights[3, U(k)] = one - weights[0, U(k)] - weights[1, U(k)] - weights[2, U(k)]


@njit(**OPTIONS)
def _divide(offset, slope, bend, one, count, shares, weights, places):  # pragma: no cover
    """Of (offset + slope·k)/(1 + bend·k), the whole part below and the weights for the rest, for k up to count."""
    for k in range(count):
        at = (offset + slope * np.float32(k)) / (one + bend * np.float32(k))
        whole = np.floor(at)
        places[U(k)] = np.int32(whole)
        shares[U(k)] = at - whole
    _cubic_weights(shares, weights, 0, count)


@njit(**PASS)
def warp(
    red, green, blue, matrix, out, v0, u0, width, first, last, line, columns, shares, weights, places
):  # pragma: no cover
    """Rows first to last of a raster, `width` pixels each, into out (rows, pixels) uint32, RGBA, from
    row v0 and pixel u0 on.

    red, green, blue: the picture, (rows, columns) uint8, whose edge goes on beside it. matrix (3, 3): its pixels from
    the raster's, pixel centres at integers; rows must stay nearly level. line, columns (3, numbers), shares (numbers,),
    weights (4, numbers), places (numbers,): to work in.
    """
    height, picture_width = red.shape
    half, none, one, most = np.float32(0.5), np.float32(0), np.float32(1), np.float32(255)
    for v in range(first, last):
        # Where the row begins and ends in the picture: a straight line.
        w = matrix[2, 1] * v + matrix[2, 2]
        x0, y0 = (matrix[0, 1] * v + matrix[0, 2]) / w, (matrix[1, 1] * v + matrix[1, 2]) / w
        u = width - 1.0
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        x1 = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
        y1 = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
        rise = (y1 - y0) / (x1 - x0)
        begin = int(np.floor(x0)) - 1  # of the picture's columns that are read, and of those between
        count = int(np.floor(x1)) + 3 - begin
        offset, slope = np.float32(y0 + rise * (begin - x0)), np.float32(rise)
        _divide(offset, slope, none, one, count, shares, weights, places)
        inner_begin, inner_end = max(0, -begin), min(count, picture_width - begin)
        k = inner_begin
        while k < inner_end:  # columns whose four rows are the same are done together
            top, end = places[U(k)], k + 1
            while end < inner_end and places[U(end)] == top:
                end += 1
            a, b = U(min(max(top - 1, 0), height - 1)), U(min(max(top, 0), height - 1))
            c, d = U(min(max(top + 1, 0), height - 1)), U(min(max(top + 2, 0), height - 1))
            at, to = U(begin + k), U(k)
            for n in range(3):
                plane = red if n == 0 else (green if n == 1 else blue)
                for i in range(end - k):
                    upper = np.float32(plane[a, U(i) + at]) * weights[0, U(i) + to]
                    upper += np.float32(plane[b, U(i) + at]) * weights[1, U(i) + to]
                    lower = np.float32(plane[c, U(i) + at]) * weights[2, U(i) + to]
                    lower += np.float32(plane[d, U(i) + at]) * weights[3, U(i) + to]
                    columns[n, U(i) + to] = upper + lower
            k = end
        for n in range(3):
            for i in range(min(inner_begin, count)):
                columns[n, U(i)] = columns[n, U(min(inner_begin, count - 1))]
            for i in range(max(inner_end, 0), count):
                columns[n, U(i)] = columns[n, U(max(inner_end - 1, 0))]
        # Along the row: x as a share of two straight lines.
        w = matrix[2, 1] * v + matrix[2, 2]
        offset, slope = np.float32((matrix[0, 1] * v + matrix[0, 2]) / w - begin), matrix[0, 0] - begin * matrix[2, 0]
        _divide(offset, np.float32(slope / w), np.float32(matrix[2, 0] / w), one, width, shares, weights, places)
        stride, u = U(weights.shape[1]), 0
        while u < width:
            source, end = places[U(u)], u + 1
            while end < width and end < u + PIECE and places[U(end)] - end == source - u:
                end += 1
            _weigh_piece(columns[0], U(source - 1), weights, U(u), stride, line[0])
            _weigh_piece(columns[1], U(source - 1), weights, U(u), stride, line[1])
            _weigh_piece(columns[2], U(source - 1), weights, U(u), stride, line[2])
            u = end
        for n in range(3):
            for u in range(width):
                line[n, U(u)] = min(max(line[n, U(u)] + half, none), most)
        row, pixel = U(v + v0), U(u0)
        for u in range(width):
            low = np.uint32(np.int32(line[0, U(u)])) | np.uint32(np.int32(line[1, U(u)])) << np.uint32(8)
            high = np.uint32(np.int32(line[2, U(u)])) << np.uint32(16) | np.uint32(0xFF000000)
            out[row, U(u) + pixel] = np.uint32(low | high)


def warped(picture: U8, matrix: F64, *, out: U8, rows: slice, columns: slice, threads: int) -> None:
    """A picture (h, w, 4) on rows and columns of a raster: into out (rows, columns, 4), opaque.

    matrix: 3x3, last entry 1, the picture's pixels from those of the drawn rows and columns, pixel centres at integers.
    """
    planes = [np.ascontiguousarray(plane) for plane in cv2.split(picture)[:3]]
    height, width = rows.stop - rows.start, columns.stop - columns.start
    pixels = out.view(np.uint32)[..., 0]

    def share(index: int) -> None:
        numbers = max(width, picture.shape[1] + 2 * MARGIN_PX) + 4 * PIECE
        line, found, weights = (np.zeros((n, numbers), np.float32) for n in (3, 3, TAPS))
        work = line, found, np.zeros(numbers, np.float32), weights, np.zeros(numbers, np.int32)
        first, last = (height * part // threads for part in (index, index + 1))
        warp(*planes, matrix, pixels, rows.start, columns.start, width, first, last, *work)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(share, range(threads)))


def is_level(matrix: F64, *, rows: slice, columns: slice, size: tuple[int, int]) -> bool:
    """Whether the raster's rows (3x3 as above) cross a picture of a size (width, height) from left to right, gently
    and nowhere far beside it."""
    right, down = columns.stop - columns.start - 1.0, rows.stop - rows.start - 1.0
    x, y, w = matrix @ [[0.0, right, 0.0, right], [0.0, 0.0, down, down], [1.0] * 4]
    if w.min() <= 0:
        return False
    x, y = x / w, y / w
    across = x[1::2] - x[::2]
    far = x.min() < -MARGIN_PX or x.max() > size[0] + MARGIN_PX or x[::2].max() >= size[0] or x[1::2].min() <= 0
    return not far and across.min() > 0 and bool((np.abs(y[1::2] - y[::2]) < RISE_MOST * across).all())
