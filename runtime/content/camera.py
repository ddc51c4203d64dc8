"""Convert a view's 3x4 projection to a rasteriser's camera, and project boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from runtime.content.base import View
from runtime.optics.rect import PixelRect
from runtime.records import F64

NEAREST_M = 1e-3  # distance of the near plane from the eye


def clip_from_stack(view: View, corners_m: F64) -> F64:
    """Return a view's 4x4 OpenGL clip matrix, with near and far planes around (8n, 3) corners.

    OpenGL's first row in memory is its lowest. The raster's v therefore runs along OpenGL's +y, so that row 0 of the
    raster is row 0 of the pixels read back, and nothing need be flipped. Raises ValueError if no corner is in front of
    the eye.
    """
    near_m, far_m = depth_bounds(view, corners_m)
    if not 0.0 < near_m < far_m:
        raise ValueError(
            f"near {near_m} and far {far_m} are not valid clipping distances; far must be greater than near"
        )
    u, v, w = view.pixels_from_stack
    span = far_m - near_m
    depth = w * ((far_m + near_m) / span) + np.array([0.0, 0.0, 0.0, -2.0 * far_m * near_m / span])
    return np.array([u * (2.0 / view.width_px) - w, v * (2.0 / view.height_px) - w, depth, w])


def box_corners(low_m: ArrayLike, high_m: ArrayLike) -> F64:
    """Return the (8, 3) corners of an axis-aligned box."""
    bounds = np.array([low_m, high_m], dtype=np.float64)
    return np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def project(pixels_from_stack: F64, points_m: F64) -> tuple[F64, F64]:
    """Return the pixels (n, 2) and depths (n,) in metres of points (n, 3) in frame `stack`.

    Pixels of points behind the eye are undefined.
    """
    homogeneous = points_m @ pixels_from_stack[:, :3].T + pixels_from_stack[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[:, :2] / homogeneous[:, 2:], homogeneous[:, 2]


def covered_box(view: View, corners_m: F64, *, align_px: int = 32) -> PixelRect:
    """Return the box of pixels that the hull of some corners may cover, rounded up to `align_px`.

    It is empty if the corners are behind the eye.
    """
    pixels, depths = project(view.pixels_from_stack, corners_m)
    if depth_bounds(view, corners_m)[1] <= 2 * NEAREST_M:
        return PixelRect(0, 0, 0, 0)
    size = [view.width_px, view.height_px]
    if (depths <= NEAREST_M).any():
        return PixelRect(0, 0, *size)
    low = np.floor((pixels.min(0) - 1) / align_px) * align_px
    high = np.ceil((pixels.max(0) + 1) / align_px) * align_px
    u0, v0 = (int(value) for value in np.clip(low, 0, size))
    u1, v1 = (int(value) for value in np.clip(high, 0, size))
    return PixelRect(u0, v0, max(u1, u0), max(v1, v0))


def depth_bounds(view: View, corners_m: F64) -> tuple[float, float]:
    """Return the near and far distance in metres, with a margin, of all corners in front of the eye."""
    depths = project(view.pixels_from_stack, corners_m)[1]
    far = float(depths.max()) * 1.001 + NEAREST_M
    return max(float(depths.min()) * 0.999 - NEAREST_M, min(NEAREST_M, far / 2)), far
