"""Compiled C++ loops, called through `ctypes`.

The GIL is released during each call, except by `frame_picture`.

The structures in this module mirror those in the C++ files field by field. In C++, `KernelImage` is called `Image`,
`KernelView` is called `View`, and `ErrorSum` is called `Result`. `library` checks that the structure sizes and the
maximum number of ray sets match the compiled values.
"""

from __future__ import annotations

import ctypes
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

MAX_PANELS = 6
MAX_SETS = 16  # maximum number of ray sets: eight views at two head positions
MARGIN = 64  # elements past the end of a row that the loops may read or overwrite, because they use whole vectors
SUBCODE = 16  # fixed-point units per 8-bit panel code
FULL = 255 * SUBCODE  # range of a panel value, which rotates the polarization by up to a quarter turn
EDGE_PX = 4  # maximum distance, in pixels, that an image may be sampled beyond its edge
EDGE_CLAMP_PX = 2  # distance, in pixels, that the values of a picture's border rays are repeated beyond it
CURVE_STEPS = 4  # entries per code of a panel's grey curve
CURVE_ENTRIES = 256 * CURVE_STEPS
TABLE_STEPS = 16  # table entries per code value, for the intensities of bilinearly sampled rays
_AGAIN = "reinstall phasestack (this requires g++)"
_pointer, _int, _long, _float, _double = (
    ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64, ctypes.c_float, ctypes.c_double
)  # fmt: skip


def with_margin(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an uninitialised array. The loops may use `MARGIN` elements past its end."""
    return np.empty(prod(shape) + MARGIN, dtype)[: prod(shape)].reshape(shape)


class KernelImage(ctypes.Structure):
    """Image of 16-bit elements with interleaved channels. Its rows may be in a ring buffer."""

    _fields_ = (("data", _pointer), ("stride", _long), ("rows", _int), ("width", _int), ("ring", _int))

    @classmethod
    def of(cls, array: NDArray[Any], *, rows: int, width: int) -> KernelImage:
        """Return an image made of the first rows and pixels of a (rows, elements) int16 array.

        The caller must keep the array alive.

        Args:
            rows: Number of rows in the image.
            width: Number of pixels in each row.
        """
        return cls(array.ctypes.data, array.strides[0] // array.itemsize, rows, width, len(array))


class Panel(ctypes.Structure):
    """Images that hold one panel's values before and after a step."""

    _fields_ = tuple((name, KernelImage) for name in ("ahead", "moved", "before", "last"))


class Problem(ctypes.Structure):
    """Arguments of `step` and `close_middle`."""

    _fields_ = (
        ("panels", _int), ("sets", _int), ("channels", _int), ("height", _int), ("width", _int),
        ("turns", _int), ("turn", _int * MAX_SETS),
        ("panels_from_rays", _pointer), ("rays_from_panels", _pointer), ("targets", _pointer * MAX_SETS),
        ("column_taper", _pointer), ("row_taper", _pointer), ("table", _pointer), ("rest", _float), ("missing", _float),
        ("panel", Panel * MAX_PANELS), ("grey", _int * MAX_PANELS),
        ("size", _float), ("momentum", _float), ("floor", _float),
    )  # fmt: skip


class Warp(ctypes.Structure):
    """Map from a raster to an image, and how far (below `EDGE_PX`) the image's edge is repeated outwards."""

    _fields_ = (
        ("image_from_raster", _double * 9), ("image_bend", _double), ("image_middle", _double),
        ("raster_bend", _double), ("raster_middle", _double), ("reach_px", _double),
    )  # fmt: skip


class KernelView(ctypes.Structure):
    """One eye's view of the displayed layers, and the target picture to compare it with."""

    _fields_ = (
        ("layers", _pointer), ("panels", _int), ("height", _int), ("width", _int), ("components", _int),
        ("target", _pointer), ("rows", _int), ("columns", _int), ("centre_from_image", _pointer),
        ("panels_from_centre", _pointer), ("toward", _pointer), ("table", _pointer), ("first_ray", _long),
        ("points", _int), ("rays", _int), ("step", _int),
    )  # fmt: skip


class ErrorSum(ctypes.Structure):
    """Sum of squared errors, and its number of terms."""

    _fields_ = (("total", _double), ("counted", _long))


class ScaleShift(ctypes.Structure):
    """Map from the screen's pixels to positions in a picture, along both axes."""

    _fields_ = (("scale_u", _float), ("scale_v", _float), ("shift_u", _float), ("shift_v", _float))


class ShownPanel(ctypes.Structure):
    """Arguments for drawing one panel's picture. Called `Shown` in C++."""

    _fields_ = (
        ("source", _pointer), ("source_stride", _long), ("screen", _pointer), ("screen_stride", _long),
        ("flat", _pointer), ("flat_stride", _long), ("curve", _pointer), ("relief", _pointer),
        ("source_rows", _int), ("source_columns", _int), ("rows", _int), ("columns", _int),
        ("relief_rows", _int), ("relief_columns", _int), ("panel_rows", _int), ("panel_columns", _int),
        ("source_from_panel", ScaleShift), ("relief_from_screen", ScaleShift), ("push", ScaleShift),
        ("registered", _int), ("panel_from_screen", _float * 9), ("flatness", _float), ("every", _int),
    )  # fmt: skip


class OutlinedPart(ctypes.Structure):
    """One part's edges, and the eye and matrix for which its outline's ramps are built."""

    _fields_ = (
        ("vertices", _pointer), ("faces", _pointer), ("ends", _pointer), ("apex", _pointer), ("normals", _pointer),
        ("heights", _pointer), ("edges", _int), ("triangles", _int),
        ("eye", _double * 3), ("clip_from_part", _double * 16),
    )  # fmt: skip


COMPILED = {
    "problem_bytes": ctypes.sizeof(Problem), "warp_bytes": ctypes.sizeof(Warp), "view_bytes": ctypes.sizeof(KernelView),
    "shown_bytes": ctypes.sizeof(ShownPanel), "outlined_part_bytes": ctypes.sizeof(OutlinedPart), "max_sets": MAX_SETS,
}  # fmt: skip


def _raise_failure(status: int, function: Any, arguments: tuple[Any, ...]) -> None:
    """Raise MemoryError or ValueError if a compiled function returned a status that is not 0."""
    if status == 2:
        raise MemoryError("no memory for a solution's rays")
    if status:
        raise ValueError(f"the compiled function {function.__name__} cannot use its arguments (sizes, or a homography)")


@cache
def library() -> Any:
    """Return the compiled library. Raises ImportError if it is missing or built from another version."""
    built = Path(__file__).with_name("compiled" + EXTENSION_SUFFIXES[0])  # a build for another Python may be outdated
    if not built.exists():
        raise ImportError(f"runtime.kernels is not compiled for this Python: {_AGAIN}")
    loops: Any = ctypes.CDLL(str(built))
    other = ImportError(f"{built} was built from another version: {_AGAIN}")
    for name, arguments in {
        "step": (_pointer, _int, _int),
        "close_middle": (_pointer, _int, _int),
        "show": (_pointer, _int, _pointer, _long, _int, _int),
        "warp": (_pointer, _pointer, _pointer, _int, _int, _int, _int),
        "squared_error": (_pointer, _int, _int, _pointer),
        "draw_panels": (_pointer, _int, _int),
        "outline_ramps": (_pointer, _pointer, _int, _double, _double, _double, _pointer, _pointer),
    }.items():
        function = getattr(loops, name, None)
        if function is None:
            raise other
        function.argtypes, function.restype = arguments, None
    reporting = ("step", "close_middle", "warp", "squared_error") if hasattr(loops, "reports_status") else ()
    for name in reporting:  # builds before the first that reported a status return nothing
        getattr(loops, name).restype, getattr(loops, name).errcheck = _int, _raise_failure
    short = ctypes.PyDLL(str(built))  # keeps the GIL, because the presenter could wait for it longer than it takes
    loops.frame_picture = short.frame_picture
    loops.frame_picture.argtypes = [_pointer, _long, _long, _int, _int, _pointer, _int, _int, _pointer]
    loops.frame_picture.restype = None
    for name, value in COMPILED.items():
        try:
            compiled = _int.in_dll(loops, name).value
        except ValueError:
            raise other from None
        if compiled != value:
            raise other
    return loops
