"""Bilinear samples of pixels of four numbers, wherever they lie."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from runtime.model.compiled.loops import CHANNELS, OPTIONS, U

LEAST_WEIGHT = np.float32(1e-6)  # of a homography: what is nearer to the eye's own plane is taken for behind it

_HALF = ir.VectorType(ir.FloatType(), CHANNELS)
_WHOLE = ir.VectorType(ir.FloatType(), 2 * CHANNELS)


@intrinsic
def _blend_pixel(typing, image, upper, lower, across, down, out, to):
    """out[to:to + 4] += bilinear samples of an image (numbers,): of the two pixels from number `upper` on, and the two
    from `lower` on; across, down: shares of the right and of the lower ones."""
    signature = types.void(image, types.uint64, types.uint64, types.float32, types.float32, out, types.uint64)

    def generate(context, builder, signature, arguments):
        image, upper, lower, across, down, out, to = arguments
        number = context.get_data_type(signature.args[0].dtype)
        data = context.make_array(signature.args[0])(context, builder, image).data

        def read(index):
            kind = ir.PointerType(ir.VectorType(number, 2 * CHANNELS))
            numbers = builder.load(builder.bitcast(builder.gep(data, [index]), kind), align=number.width // 8)
            return (
                builder.sitofp(numbers, _WHOLE) if signature.args[0].dtype.signed else builder.uitofp(numbers, _WHOLE)
            )

        def splat(value, kind):
            one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
            mask = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
            return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), mask)

        def part(vector, begin):
            mask = ir.Constant(ir.VectorType(ir.IntType(32), CHANNELS), [begin + k for k in range(CHANNELS)])
            return builder.shuffle_vector(vector, ir.Constant(_WHOLE, ir.Undefined), mask)

        def mixed(a, b, share):
            step = builder.fmul(builder.fsub(b, a), share, flags=["contract"])
            return builder.fadd(a, step, flags=["contract"])

        both = mixed(read(upper), read(lower), splat(down, _WHOLE))
        found = mixed(part(both, 0), part(both, CHANNELS), splat(across, _HALF))
        place = context.make_array(signature.args[5])(context, builder, out).data
        place = builder.bitcast(builder.gep(place, [to]), ir.PointerType(_HALF))
        builder.store(builder.fadd(builder.load(place, align=4), found), place, align=4)
        return context.get_dummy_value()

    return signature, generate


@njit(**OPTIONS)
def locate(matrix, row, first, count, width, height, upper, lower, across, down, within):  # pragma: no cover
    """Where pixels of a row from `first` on lie in an image of so many pixels, pixel centres at integers: numbers of
    its left neighbours above and below, and shares of the others; `within` becomes 0 where they lie beside it.

    matrix (3, 3): the image's pixels from the row's, of a weight of about 1.
    """
    none, one = np.float32(0), np.float32(1)
    most_u, most_v = np.float32(width - 1), np.float32(height - 1)
    last_u, last_v = np.int32(max(width - 2, 0)), np.int32(max(height - 2, 0))
    below = np.int32(width if height > 1 else 0)
    au = np.float32(matrix[0, 0] * first + matrix[0, 1] * row + matrix[0, 2])
    av = np.float32(matrix[1, 0] * first + matrix[1, 1] * row + matrix[1, 2])
    aw = np.float32(matrix[2, 0] * first + matrix[2, 1] * row + matrix[2, 2])
    bu, bv, bw = np.float32(matrix[0, 0]), np.float32(matrix[1, 0]), np.float32(matrix[2, 0])
    for k in range(count):
        w = aw + bw * np.float32(k)
        ahead = w > LEAST_WEIGHT
        share = one / w if ahead else none
        u, v = (au + bu * np.float32(k)) * share, (av + bv * np.float32(k)) * share
        seen = ahead & (u >= none) & (u <= most_u) & (v >= none) & (v <= most_v)
        within[U(k)] = within[U(k)] if seen else none
        u, v = min(max(u, none), most_u), min(max(v, none), most_v)
        left, top = min(np.int32(u), last_u), min(np.int32(v), last_v)
        across[U(k)], down[U(k)] = u - np.float32(left), v - np.float32(top)
        upper[U(k)] = (top * np.int32(width) + left) * np.int32(CHANNELS)
        lower[U(k)] = (top * np.int32(width) + left + below) * np.int32(CHANNELS)


@njit(**OPTIONS)
def sample_pixels(image, upper, lower, across, down, count, out):  # pragma: no cover
    """Adds what `locate` found of an image (numbers,) to as many pixels of out (numbers,) float32."""
    for k in range(count):
        at = U(k)
        _blend_pixel(image, U(upper[at]), U(lower[at]), across[at], down[at], out, at * U(CHANNELS))
