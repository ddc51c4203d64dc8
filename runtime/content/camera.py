"""Convert a view's 3x4 projection to an OpenGL clip matrix, and project points and boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from runtime.content.base import View
from runtime.optics.rect import PixelRect
from runtime.records import F64

NEAREST_M = 1e-3  # distance from the eye to the near plane


def clip_from_stack(view: View, *, near_m: float, far_m: float) -> F64:
    """Return the 4x4 OpenGL clip matrix for a view, whose far plane is farther than the near one.
    The raster's v axis is mapped to OpenGL's +y, whose rows are stored bottom first, so pictures that are read back
    need not be flipped.
    """
    u, v, w = view.pixels_from_stack
    span = far_m - near_m
    depth = w * ((far_m + near_m) / span) + np.array([0.0, 0.0, 0.0, -2.0 * far_m * near_m / span])
    return np.array([u * (2.0 / view.width_px) - w, v * (2.0 / view.height_px) - w, depth, w])


def box_corners(low_m: ArrayLike, high_m: ArrayLike) -> F64:
    """Return the eight corners of an axis-aligned box as an (8, 3) array."""
    bounds = np.array([low_m, high_m], dtype=np.float64)
    return np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def pixels_and_depths(pixels_from_stack: F64, points_m: F64) -> tuple[F64, F64]:
    """Project points (n, 3) in `stack` to pixels (n, 2), undefined behind the eye, and depths in metres."""
    # A contiguous row per coordinate makes the arithmetic and the reductions several times as fast.
    homogeneous = pixels_from_stack[:, :3] @ points_m.T + pixels_from_stack[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (homogeneous[:2] / homogeneous[2]).T, homogeneous[2]


def covered_box(view: View, points_m: F64, *, align_px: int = 32) -> PixelRect:
    """Return a box, in multiples of `align_px`, that contains the convex hull of points (n, 3) in
    `stack`, within the raster. It is empty if all points are behind the eye, and the whole raster if some of them are.
    """
    pixels, depths = pixels_and_depths(view.pixels_from_stack, points_m)
    if _bounds(depths)[1] <= 2 * NEAREST_M:
        return PixelRect(0, 0, 0, 0)
    size = [view.width_px, view.height_px]
    if depths.min() <= NEAREST_M:
        return PixelRect(0, 0, *size)
    low = np.floor((pixels.min(0) - 1) / align_px) * align_px
    high = np.ceil((pixels.max(0) + 1) / align_px) * align_px
    u0, v0 = (int(value) for value in np.clip(low, 0, size))
    u1, v1 = (int(value) for value in np.clip(high, 0, size))
    return PixelRect(u0, v0, max(u1, u0), max(v1, v0))


def depth_bounds(view: View, corners_m: F64) -> tuple[float, float]:
    """Return near and far distances in metres that leave a margin around all corners in front of the eye."""
    return _bounds(corners_m @ view.pixels_from_stack[2, :3] + view.pixels_from_stack[2, 3])


def _bounds(depths_m: F64) -> tuple[float, float]:
    far = float(depths_m.max()) * 1.001 + NEAREST_M
    return max(float(depths_m.min()) * 0.999 - NEAREST_M, min(NEAREST_M, far / 2)), far
