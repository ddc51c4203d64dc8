"""Compiled C++ loops (`compiled.pyi`), and the constants that Python shares with them.

Other Python threads run during each call, except during `frame_picture`.

The functions that draw panels are called through `ctypes` (`panel_loops`). Their structures mirror those in
`panels.cpp` field by field.
"""

from __future__ import annotations

import ctypes
from functools import cache
from importlib import import_module
from typing import Any

INTERFACE = 1  # also in binding.cpp; raised by every change to the compiled module's interface
MAX_PANELS = 6  # a stack has 2 to 6
SUBCODE = 16  # fixed-point units per 8-bit panel code
FULL = 255 * SUBCODE  # range of a panel value, which rotates the polarization by up to a quarter turn
EDGE_PX = 4  # maximum distance, in pixels, that an image may be sampled beyond its edge
EDGE_CLAMP_PX = 2  # distance, in pixels, that the values of a picture's border rays are repeated beyond it
CURVE_STEPS = 4  # entries per code of a panel's grey curve
CURVE_ENTRIES = 256 * CURVE_STEPS
TABLE_STEPS = 16  # table entries per code value, for the intensities of bilinearly sampled rays
_AGAIN = "reinstall phasestack (this requires g++)"
_pointer, _int, _long, _float = ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64, ctypes.c_float


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


@cache
def library() -> Any:
    """Return the compiled module. Raises ImportError if it is missing or built from another version."""
    try:
        loops = import_module("runtime.kernels.compiled")
    except ImportError as error:
        raise ImportError(f"runtime.kernels is not compiled for this Python: {_AGAIN}; {error}") from error
    if getattr(loops, "INTERFACE", None) != INTERFACE:
        raise ImportError(f"{loops.__file__} was built from another version: {_AGAIN}")
    return loops


@cache
def panel_loops() -> Any:
    """Return the functions that draw panels. Raises ImportError as `library` does."""
    built = library().__file__
    loops: Any = ctypes.CDLL(built)
    loops.draw_panels.argtypes, loops.draw_panels.restype = [_pointer, _int, _int], None
    if _int.in_dll(loops, "shown_bytes").value != ctypes.sizeof(ShownPanel):
        raise ImportError(f"{built} was built from another version: {_AGAIN}")
    short = ctypes.PyDLL(built)  # keeps Python's lock, because waiting for it again may take longer
    loops.frame_picture = short.frame_picture
    loops.frame_picture.argtypes = [_pointer, _long, _long, _int, _int, _pointer, _int, _int, _pointer]
    loops.frame_picture.restype = None
    return loops
