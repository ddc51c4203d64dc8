"""Convert arrays, tensors and Pillow images to pictures, and find the eyes in a picture."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from runtime.errors import InputError
from runtime.evaluation.displayed import Picture
from runtime.eyes import pupils
from runtime.eyes.pupils import Pupils
from runtime.records import F64, U8
from runtime.support.picture_file import rgb_of

LEAST_PX = 16
SLACK = 1e-3  # tolerance for rounding errors: a quarter of an 8-bit level
OVERSHOOT = 0.3  # how far resampled values may be outside the range, as a fraction of white


def as_picture(name: str, given: Any) -> Picture:
    """Convert an array, a tensor, or a Pillow image to (h, w, 3) uint8, or float32 in [0, 1], over white.
    Raises ValueError, which suggests a conversion, if the shape, dtype or values of `name` do not fit.
    """
    picture: Any = _from_pillow(name, given) if hasattr(given, "getbands") else as_array(name, given)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4) or min(picture.shape[:2]) < LEAST_PX:
        told = f"shape must be (h, w, 3) or (h, w, 4), with h and w at least {LEAST_PX}, but is {picture.shape}"
        raise ValueError(f"{name}: {told}{_advice_on_shape(name, picture, is_tensor=hasattr(given, 'detach'))}")
    if picture.dtype != np.uint8:
        if not np.issubdtype(picture.dtype, np.floating):
            told = f"must be uint8 (0 to 255) or floating point (0 to 1), not {picture.dtype}"
            raise ValueError(f"{name}: {told}{_advice_on_type(name, picture)}")
        low, high = (float(bound) for bound in (picture.min(), picture.max()))
        if not (low >= -SLACK and high <= 1 + SLACK):  # also refuses NaN
            raise ValueError(
                f"{name}: values must be from 0 to 1, but range from {low:g} to "
                f"{high:g}{_advice_on_range(name, low, high)}"
            )
        picture = picture.astype(np.float32).clip(0, 1)
    if picture.shape[2] == 3:
        return np.ascontiguousarray(picture)
    full = 255 if picture.dtype == np.uint8 else 1
    alpha = picture[..., 3:].astype(np.float32) / full
    mixed = picture[..., :3] * alpha + full * (1 - alpha)
    return np.ascontiguousarray((np.rint(mixed) if full == 255 else mixed).astype(picture.dtype))


def as_array(name: str, given: Any) -> Any:
    """Convert an array, or a tensor on any device, to NumPy. Raises ValueError, which begins with `name`."""
    if isinstance(given, str | os.PathLike):
        raise ValueError(
            f"{name}: must be a picture, not a file name; read it with PIL.Image.open({os.fspath(given)!r})"
        )
    if hasattr(given, "read"):
        raise ValueError(f"{name}: must be a picture, not an open file; pass PIL.Image.open({name})")
    if np.ma.is_masked(given):
        raise ValueError(f"{name}: some values are masked; pass {name}.filled(0), or another value to show there")
    try:
        if _is_tensor(given):
            given = given.detach().cpu()
            given = given.float() if given.is_floating_point() else given
        array = np.asarray(given)
    except (TypeError, ValueError, RuntimeError):
        array = np.empty(0, object)
    if array.dtype.name == "bfloat16":  # a jax array
        array = array.astype(np.float32)
    if array.dtype.kind not in "buif":
        kind = f"array of {given.dtype}" if isinstance(given, np.ndarray) else type(given).__name__
        raise ValueError(f"{name}: must be an array of numbers, not {kind}")
    return array


def as_numbers(name: str, given: Any, told: str) -> F64:
    """Convert numbers, or tensors on any device, to float64. Raises ValueError, `name` and `told`."""
    try:
        numbers = np.asarray(_detached(given))
        return numbers.astype(np.float64, casting="same_kind" if numbers.dtype.kind == "c" else "unsafe")
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name}: {told}") from None


def _detached(given: Any) -> Any:
    if isinstance(given, list | tuple):
        return [_detached(item) for item in given]
    return given.detach().cpu() if _is_tensor(given) else given


def _is_tensor(given: Any) -> bool:
    return hasattr(given, "detach") and hasattr(given, "cpu")  # files also have a method `detach`


def _from_pillow(name: str, image: Any) -> U8:
    """Convert any Pillow image, with its colour profile, to upright sRGB. Raises ValueError if that fails."""
    try:
        return rgb_of(image, name)
    except InputError as error:
        raise ValueError(str(error)) from None
    except (OSError, ValueError) as error:  # only now does Pillow notice a file that is truncated or closed
        raise ValueError(f"{name}: cannot be decoded: {error}") from None


def _advice_on_shape(name: str, picture: Any, *, is_tensor: bool) -> str:
    if picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 1):
        return f"; for a grey picture, pass np.dstack([{name}] * 3)"
    is_batch = picture.ndim == 4 and picture.shape[0] == 1
    one = f"{name}[0]" if is_batch else name
    if picture.ndim == 3 + is_batch and picture.shape[is_batch] in (3, 4) and picture.shape[-1] not in (3, 4):
        last = f"{one}.permute(1, 2, 0)" if is_tensor else f"np.moveaxis({one}, 0, -1)"
        return f"; channels must come last, so pass {last}"
    return f"; pass one picture, such as {one}" if is_batch else ""


def _advice_on_type(name: str, picture: Any) -> str:
    if picture.dtype == np.bool_:
        return f"; pass {name} * np.uint8(255)"
    if picture.min() >= 0 and picture.max() <= 255:
        return f"; pass np.asarray({name}, np.uint8)"
    return (
        f"; if white is 65535, pass {name} / 65535" if picture.dtype == np.uint16 else "; divide by the value of white"
    )


def _advice_on_range(name: str, low: float, high: float) -> str:
    if not np.isfinite([low, high]).all():
        return "; some values are not finite"
    if low >= -OVERSHOOT and high <= 1 + OVERSHOOT:
        return f"; pass np.clip({name}, 0, 1)"
    if low >= -1 - OVERSHOOT and high <= 1 + OVERSHOOT:
        return f"; if the range is -1 to 1, pass ({name} + 1) / 2"
    if low >= -255 * OVERSHOOT and high <= 255 * (1 + OVERSHOOT):
        return f"; if white is 255, pass np.clip({name} / 255, 0, 1)"
    return f"; if white is 65535, pass np.clip({name} / 65535, 0, 1)" if low >= 0 and high <= 65535 else ""


def as_codes(picture: Picture) -> U8:
    """Round floating-point intensities to the nearest 8-bit values, and leave uint8 pictures unchanged."""
    codes: Any = picture if picture.dtype == np.uint8 else np.rint(picture * 255).astype(np.uint8)
    return np.asarray(codes, np.uint8)


def find_eyes(picture: ArrayLike) -> Pupils | None:
    """Find the nearest viewer's pupils in a picture (h, w, 3 or 4), uint8 or floats in 0..1, or a Pillow
    image, or None. `eyes_px` (2, 2) has pixel centres at half-integers and the viewer's left eye first, which is on the
    right unless mirrored; `sigma_px` is each coordinate's standard deviation. Raises ValueError for anything else.
    """
    return pupils.find_eyes(as_codes(as_picture("picture", picture)))
