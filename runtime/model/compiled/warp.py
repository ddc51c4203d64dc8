"""A picture on a raster by cubic samples, in two passes: down its columns, then along its rows.

A row of the raster is a straight line in the picture. What that line crosses of each of the picture's columns is
sampled first, and what was found then at the raster's pixels (Catmull and Smith, SIGGRAPH 1980): eight numbers of the
picture for one of the raster instead of sixteen. A pixel's four numbers are weighed at once.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from runtime.model.compiled.loops import CHANNELS, OPTIONS, PASS, U
from runtime.records import F64, U8
from runtime.support.threads import on_rows

CUBIC = np.float32(-0.75)  # of the kernel, as OpenCV's
TAPS = 4
RISE_MOST = (
    0.25  # of a row of the raster in the picture, rows for a column: steeper ones lose sharpness in the first pass
)
MARGIN_PX = 2048  # of a picture that a row may reach beside it

_PIXEL = ir.VectorType(ir.FloatType(), CHANNELS)


@intrinsic
def _weigh_bytes(typing, image, first, second, third, fourth, weights, start, stride, out, to):
    """out[to:to + 4] = the sum over t of weights[t·stride + start] times the four numbers of an image (numbers,) uint8
    from its t-th place on."""
    signature = types.void(image, *(types.uint64,) * TAPS, weights, types.uint64, types.uint64, out, types.uint64)

    def generate(context, builder, signature, arguments):
        weights, start, stride, out, to = arguments[1 + TAPS :]
        total = None
        for tap, place in enumerate(arguments[1 : 1 + TAPS]):
            kind = ir.VectorType(ir.IntType(8), CHANNELS)
            read = builder.load(_place(context, builder, signature.args[0], arguments[0], place, kind), align=1)
            weight = _weight(context, builder, signature.args[1 + TAPS], weights, start, stride, tap)
            total = _add_product(builder, total, builder.uitofp(read, _PIXEL), weight)
        builder.store(total, _place(context, builder, signature.args[-2], out, to, _PIXEL), align=4)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _weigh_pixels(typing, pixels, source, weights, start, stride, out, to):
    """out[to:to + 4] = the sum over t of weights[t·stride + start] times the four numbers of the t-th pixel from number
    `source` on, rounded, as uint8, the fourth 255."""
    signature = types.void(pixels, types.uint64, weights, types.uint64, types.uint64, out, types.uint64)

    def generate(context, builder, signature, arguments):
        pixels, source, weights, start, stride, out, to = arguments
        total = ir.Constant(_PIXEL, [0.5] * CHANNELS)
        for tap in range(TAPS):
            at = builder.add(source, ir.Constant(ir.IntType(64), CHANNELS * tap))
            read = builder.load(_place(context, builder, signature.args[0], pixels, at, _PIXEL), align=4)
            weight = _weight(context, builder, signature.args[2], weights, start, stride, tap)
            total = _add_product(builder, total, read, weight)
        none, most = ir.Constant(_PIXEL, [0.0] * CHANNELS), ir.Constant(_PIXEL, [255.0] * CHANNELS)
        total = builder.select(builder.fcmp_ordered("<", total, none), none, total)
        total = builder.select(builder.fcmp_ordered(">", total, most), most, total)
        bytes_ = ir.VectorType(ir.IntType(8), CHANNELS)
        codes = builder.trunc(builder.fptosi(total, ir.VectorType(ir.IntType(32), CHANNELS)), bytes_)
        codes = builder.or_(codes, ir.Constant(bytes_, [0, 0, 0, 255]))
        builder.store(codes, _place(context, builder, signature.args[-2], out, to, bytes_), align=1)
        return context.get_dummy_value()

    return signature, generate


def _place(context, builder, kind, array, index, vector):
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), ir.PointerType(vector))


def _weight(context, builder, kind, weights, start, stride, tap):
    """The same for all numbers of a pixel."""
    index = builder.add(start, builder.mul(stride, ir.Constant(ir.IntType(64), tap)))
    value = builder.load(builder.gep(context.make_array(kind)(context, builder, weights).data, [index]))
    one = builder.insert_element(ir.Constant(_PIXEL, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    same = ir.Constant(ir.VectorType(ir.IntType(32), CHANNELS), [0] * CHANNELS)
    return builder.shuffle_vector(one, ir.Constant(_PIXEL, ir.Undefined), same)


def _add_product(builder, total, a, b):
    product = builder.fmul(a, b, flags=["contract"])
    return product if total is None else builder.fadd(total, product, flags=["contract"])


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
    picture, height, picture_width, matrix, out, first, last, v0, u0, width, columns, shares, weights, places
):  # pragma: no cover
    """Rows first to last of a raster, `width` pixels each, into out (rows, numbers) uint8, RGBA, from row v0 and
    pixel u0 on.

    picture (numbers,): `height` times `picture_width` pixels RGBA, whose edge goes on beside it. matrix (3, 3): its
    pixels from the raster's, pixel centres at integers; rows must stay nearly level. columns (numbers,), shares
    (pixels,), weights (4, pixels), places (pixels,): to work in.
    """
    none, one, stride = np.float32(0), np.float32(1), U(weights.shape[1])
    line = U(picture_width * CHANNELS)
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
            for i in range(k, end):
                x = U(begin + i) * U(CHANNELS)
                places_of = a * line + x, b * line + x, c * line + x, d * line + x
                _weigh_bytes(picture, *places_of, weights, U(i), stride, columns, U(i) * U(CHANNELS))
            k = end
        for k in range(min(inner_begin, count) * CHANNELS):
            columns[U(k)] = columns[U(min(inner_begin, count - 1) * CHANNELS + k % CHANNELS)]
        for k in range(max(inner_end, 0) * CHANNELS, count * CHANNELS):
            columns[U(k)] = columns[U(max(inner_end - 1, 0) * CHANNELS + k % CHANNELS)]
        # Along the row: x as a share of two straight lines.
        w = matrix[2, 1] * v + matrix[2, 2]
        offset, slope = np.float32((matrix[0, 1] * v + matrix[0, 2]) / w - begin), matrix[0, 0] - begin * matrix[2, 0]
        _divide(offset, np.float32(slope / w), np.float32(matrix[2, 0] / w), one, width, shares, weights, places)
        to = U(v + v0) * U(out.shape[1]) + U(u0) * U(CHANNELS)
        for i in range(width):
            source = U(places[U(i)] - 1) * U(CHANNELS)
            _weigh_pixels(columns, source, weights, U(i), stride, out, to + U(i) * U(CHANNELS))


def warped(picture: U8, matrix: F64, *, out: U8, rows: slice, columns: slice) -> None:
    """A picture (h, w, 4) on rows and columns of a raster: into out (rows, columns, 4), opaque.

    matrix: 3x3, last entry 1, the picture's pixels from those of the drawn rows and columns, pixel centres at integers;
    rows are nearly level in the picture (`is_level`).
    """
    height, width = rows.stop - rows.start, columns.stop - columns.start
    source = np.ascontiguousarray(picture).reshape(-1), *picture.shape[:2], matrix, out.reshape(out.shape[0], -1)
    place = rows.start, columns.start, width

    def share(first: int, last: int) -> None:
        pixels = max(width, picture.shape[1] + 2 * MARGIN_PX) + TAPS
        sampled, shares = np.zeros(pixels * CHANNELS, np.float32), np.zeros(pixels, np.float32)
        weights, places = np.zeros((TAPS, pixels), np.float32), np.zeros(pixels, np.int32)
        warp(*source, first, last, *place, sampled, shares, weights, places)

    on_rows(share, height)


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
