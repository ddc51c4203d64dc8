"""What compiled loops share: how they are compiled, the sizes that they work in, and the processor's widest reads.

Where the scale between two rasters is near one, runs of pixels lie the same whole number of pixels beside their source:
within such a piece all that is read is contiguous and the weights grow evenly.
"""

# Indices are unsigned: of signed ones numba asks whether they count from the end, and loops are not vectorised.
# Rows are no slices: each slice is counted twice, across threads.
from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import config

from runtime.records import I16

PIECE = 32  # numbers that are blended at once
TILE = 960  # numbers of a row that are done together: they stay in the nearest cache
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
CHANNELS = 4  # of a picture's pixel, RGBA
U = np.uint64

VECTOR = ir.VectorType(ir.FloatType(), PIECE)


def loaded(context, builder, kind, array, index):
    """`PIECE` numbers of an array from an index on, as floats."""
    number = context.get_data_type(kind.dtype)
    vector = ir.VectorType(number, PIECE)
    place = builder.gep(context.make_array(kind)(context, builder, array).data, [index])
    read = builder.load(builder.bitcast(place, ir.PointerType(vector)), align=kind.dtype.bitwidth // 8)
    return read if isinstance(number, ir.FloatType) else builder.sitofp(read, VECTOR)


def everywhere(builder, value):
    """`PIECE` times the same number."""
    empty, first = ir.Constant(VECTOR, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    mask = ir.Constant(ir.VectorType(ir.IntType(32), PIECE), [0] * PIECE)
    return builder.shuffle_vector(builder.insert_element(empty, value, first), empty, mask)


def numbers_of(image: I16) -> I16:
    """(rows, numbers): the buffer that an image begins, with what is behind it."""
    parent = image.base
    assert isinstance(parent, np.ndarray)
    return parent.reshape(parent.shape[0], -1)
