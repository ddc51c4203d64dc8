"""Compiled C++ loops (`compiled.pyi`), and the constants that Python shares with them.

Other Python threads run during each call, except during `frame_picture`: the presenter's thread could wait longer for
Python's lock than the call takes.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

INTERFACE = 2  # also in binding.cpp; raised by every change to the compiled module's interface
MAX_PANELS = 6  # a stack has 2 to 6
SUBCODE = 16  # fixed-point units per 8-bit panel code
FULL = 255 * SUBCODE  # range of a panel value, which rotates the polarization by up to a quarter turn
EDGE_PX = 4  # maximum distance, in pixels, that an image may be sampled beyond its edge
EDGE_CLAMP_PX = 2  # distance, in pixels, that the values of a picture's border rays are repeated beyond it
CURVE_STEPS = 4  # entries per code of a panel's grey curve
CURVE_ENTRIES = 256 * CURVE_STEPS
TABLE_STEPS = 16  # table entries per code value, for the intensities of bilinearly sampled rays
_AGAIN = "reinstall phasestack (this requires g++)"


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
