"""Sample pictures at pixel positions, which count from the corner and are clamped to the picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.records import F32, F64, U8

Pixels = NDArray[np.floating[Any]]


def projected(matrix: F64, u: Pixels, v: Pixels) -> tuple[Pixels, Pixels, Pixels]:
    """Return x, y and the weight to which a 3x3 homography maps u and v, which are broadcast.
    At a weight of 0, x and y are not finite.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
        return x, (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w, w


def bilinear(picture: U8 | F32, x: Pixels, y: Pixels) -> F32:
    """Return an (H, W[, C]) picture's values at positions x and y (NaN counts as 0), which are broadcast
    to (h, w). Weights have full precision, which OpenCV's own interpolation does not offer.
    """
    height, width = picture.shape[:2]
    left, right = _split(x, width)
    top, down = _split(y, height)
    # OpenCV gathers an order of magnitude faster than NumPy.
    corner = np.empty((*np.broadcast_shapes(left.shape, top.shape), 2), np.int16)
    corner[..., 0], corner[..., 1] = left, top
    if picture.ndim == 3:
        right, down = right[..., None], down[..., None]
    below, beside = picture[min(1, height - 1) :], slice(min(1, width - 1), None)
    above = _mixed(_at(picture, corner), _at(picture[:, beside], corner), right)
    return _mixed(above, _mixed(_at(below, corner), _at(below[:, beside], corner), right), down)


def nearest(picture: U8 | F32, x: Pixels, y: Pixels) -> F32:
    """Return the values of the pixels that positions are in. Arguments are those of `bilinear`."""
    height, width = picture.shape[:2]
    corner = np.empty((*np.broadcast_shapes(x.shape, y.shape), 2), np.int16)
    corner[..., 0] = np.fmin(np.fmax(x, 0), width - 1)
    corner[..., 1] = np.fmin(np.fmax(y, 0), height - 1)
    return _at(picture, corner)


def _split(place: Pixels, count: int) -> tuple[Pixels, F32]:
    """Return the last of `count` pixel centres before each position, and the distance from there."""
    # fmax and fmin ignore NaN.
    inside = np.fmin(np.fmax(place - place.dtype.type(0.5), 0), count - 1)
    low = np.fmin(np.floor(inside), max(count - 2, 0))
    return low, (inside - low).astype(np.float32)


def _at(picture: U8 | F32, corner: NDArray[np.int16]) -> F32:
    no_second_map: Any = None  # OpenCV accepts None, but its type stubs do not
    return np.asarray(cv2.remap(picture, corner, no_second_map, cv2.INTER_NEAREST), np.float32)


def _mixed(a: F32, b: F32, weight: F32) -> F32:
    """Return a + (b - a)·weight. Overwrites a and b."""
    b -= a
    b *= weight
    a += b
    return a
