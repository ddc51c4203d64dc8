"""The compiled C++ loops, called by `ctypes`, which lets other threads run meanwhile.

The structures below are those of the C++ files, field by field (`KernelImage` is `Image` there, `KernelView` is `View`,
`ErrorSum` is `Result`); `library` compares their sizes and the limit of ray sets.
"""

from __future__ import annotations

import ctypes
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

MAX_PANELS = 5
MAX_SETS = 4  # of rays: left and right eye's, at two places
MARGIN = 64  # elements after an image's rows that loops may touch
SUBCODE = 16  # fixed point: sixteenths of an 8-bit panel code
FULL = 255 * SUBCODE  # one panel's whole range, a quarter turn
EDGE_PX = 4  # pixels outside an image that may be sampled
EDGE_CLAMP_PX = 2  # pixels outside a picture to which its border ray bundles are extended (clamp to edge)
TABLE_STEPS = 16  # entries for a code value in the table of intensities, for bilinear rays
_AGAIN = "install phasestack again (it needs g++)"
_pointer, _int, _long, _float, _double = (
    ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64, ctypes.c_float, ctypes.c_double
)  # fmt: skip


class KernelImage(ctypes.Structure):
    """Rows of 16-bit elements, interleaved channels."""

    _fields_ = (("data", _pointer), ("stride", _long), ("rows", _int), ("width", _int), ("ring", _int))

    @classmethod
    def of(cls, array: NDArray[Any], *, rows: int, width: int) -> KernelImage:
        """The first rows and pixels of an int16 array (rows, elements), which must live as long."""
        return cls(array.ctypes.data, array.strides[0] // array.itemsize, rows, width, len(array))


class Panel(ctypes.Structure):
    """One panel between steps."""

    _fields_ = tuple((name, KernelImage) for name in ("ahead", "moved", "before", "last"))


class Problem(ctypes.Structure):
    """Arguments of a step."""

    _fields_ = (
        ("panels", _int), ("sets", _int), ("channels", _int), ("height", _int), ("width", _int),
        ("panels_from_rays", _pointer), ("rays_from_panels", _pointer), ("targets", _pointer * 2),
        ("column_taper", _pointer), ("row_taper", _pointer), ("table", _pointer), ("rest", _float), ("missing", _float),
        ("panel", Panel * MAX_PANELS), ("size", _float), ("momentum", _float), ("floor", _float),
    )  # fmt: skip


class Warp(ctypes.Structure):
    """Map from a raster to an image, and the distance up to which its edge is clamped (less than `EDGE_PX`)."""

    _fields_ = (
        ("image_from_raster", _double * 9), ("image_bend", _double), ("image_middle", _double),
        ("raster_bend", _double), ("raster_middle", _double), ("reach_px", _double),
    )  # fmt: skip


class KernelView(ctypes.Structure):
    """One eye's view of displayed layers."""

    _fields_ = (
        ("layers", _pointer), ("panels", _int), ("height", _int), ("width", _int), ("components", _int),
        ("target", _pointer), ("rows", _int), ("columns", _int), ("centre_from_image", _pointer),
        ("panels_from_centre", _pointer), ("toward", _pointer), ("table", _pointer), ("first_ray", _long),
        ("points", _int), ("rays", _int), ("step", _int),
    )  # fmt: skip


class ErrorSum(ctypes.Structure):
    """Sum of a squared error, and the number of its terms."""

    _fields_ = (("total", _double), ("counted", _long))


COMPILED = {
    "problem_bytes": ctypes.sizeof(Problem), "warp_bytes": ctypes.sizeof(Warp), "view_bytes": ctypes.sizeof(KernelView),
    "max_sets": MAX_SETS,
}  # fmt: skip


@cache
def library() -> Any:
    """The loops. Raises ImportError where the package was not built for this machine, or from other sources."""
    built = Path(__file__).with_name("compiled" + EXTENSION_SUFFIXES[0])  # another Python's may be a stale one
    if not built.exists():
        raise ImportError(f"runtime.kernels is not compiled for this Python: {_AGAIN}")
    loops = ctypes.CDLL(str(built))
    other = ImportError(f"{built} is of another version: {_AGAIN}")
    for name, arguments in {
        "step": (_pointer, _int, _int),
        "close_middle": (_pointer, _int, _int),
        "show": (_pointer, _int, _pointer, _long, _int, _int),
        "warp": (_pointer, _pointer, _pointer, _int, _int, _int, _int),
        "squared_error": (_pointer, _int, _int, _pointer),
    }.items():
        function = getattr(loops, name, None)
        if function is None:
            raise other
        function.argtypes, function.restype = arguments, None
    for name, value in COMPILED.items():
        try:
            compiled = _int.in_dll(loops, name).value
        except ValueError:
            raise other from None
        if compiled != value:
            raise other
    return loops
