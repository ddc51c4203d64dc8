"""Pictures as programs have them (arrays of codes or of intensities), and the eyes in them."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from runtime.evaluation.displayed import Picture
from runtime.eyes import pupils
from runtime.eyes.pupils import Pupils
from runtime.records import U8

LEAST_PX = 16


def as_picture(name: str, given: ArrayLike) -> Picture:
    """(h, w, 3) uint8, or intensities in [0, 1] as float32; where it is transparent, white shows through.

    Raises ValueError, naming the argument.
    """
    if isinstance(given, str | os.PathLike):
        raise ValueError(f"{name}: is a file's name: read it first, as with numpy.asarray(PIL.Image.open({given!r}))")
    picture: Any = np.asarray(given)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4) or min(picture.shape[:2]) < LEAST_PX:
        advice = ""
        if picture.ndim == 2:
            advice = f": a grey one is np.dstack([{name}] * 3)"
        elif picture.ndim == 3 and picture.shape[0] in (3, 4):
            advice = f": channels come last, np.moveaxis({name}, 0, -1)"
        elif picture.ndim == 4 and picture.shape[0] == 1:
            advice = f": one picture, {name}[0]"
        raise ValueError(
            f"{name}: has the shape {picture.shape}, not (h, w, 3|4) with {LEAST_PX} pixels at least{advice}"
        )
    if picture.dtype != np.uint8:
        if not np.issubdtype(picture.dtype, np.floating):
            advice = f": codes are {name}.astype(np.uint8)" if np.issubdtype(picture.dtype, np.integer) else ""
            raise ValueError(f"{name}: is of {picture.dtype}, neither uint8 (0..255) nor floating point (0..1){advice}")
        low, high = (float(bound) for bound in (picture.min(), picture.max()))
        if not (low >= 0 and high <= 1):  # nor NaN
            advice = f": divide by 255, or {name}.astype(np.uint8)" if low >= 0 and 1 < high <= 255 else ""
            raise ValueError(f"{name}: holds {low:g} to {high:g}, not within 0 and 1{advice}")
        picture = picture.astype(np.float32)
    if picture.shape[2] == 3:
        return np.ascontiguousarray(picture)
    full = 255 if picture.dtype == np.uint8 else 1
    alpha = picture[..., 3:].astype(np.float32) / full
    mixed = picture[..., :3] * alpha + full * (1 - alpha)
    return np.ascontiguousarray((np.rint(mixed) if full == 255 else mixed).astype(picture.dtype))


def as_codes(picture: Picture) -> U8:
    """The nearest 8-bit codes."""
    codes: Any = picture if picture.dtype == np.uint8 else np.rint(picture * 255).astype(np.uint8)
    return np.asarray(codes, np.uint8)


def find_eyes(picture: ArrayLike) -> Pupils | None:
    """The foremost viewer's pupils in an (h, w, 3|4) picture, uint8 or float in 0..1; None: nobody.

    `eyes_px` is (2, 2): the viewer's left eye first, which is on the right of an unmirrored picture; continuous pixels,
    centres at half-integers. `sigma_px` says how sure they are. Raises ValueError for what is no picture.
    """
    return pupils.find_eyes(as_codes(as_picture("picture", picture)))
