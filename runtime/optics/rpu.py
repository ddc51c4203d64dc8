"""Reverse perspective uniform: panel pixels from an eye's image pixels (EyeReal supplement, 3.2, (40)-(47)).

Its misprints are listed and mended in docs/mathematics.md.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.stack import PlaneRaster
from runtime.optics.views import image_from_raster
from runtime.records import F64


def panel_corners_px(raster: PlaneRaster) -> F64:
    """(4, 2) outer corners Q_n in the EyeReal supplement's order 0-3: (0, 0), (W, 0), (W, H), (0, H)."""
    width, height = float(raster.width_px), float(raster.height_px)
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def image_from_panel_four_points(corners_px: ArrayLike, *, width_px: float, height_px: float) -> F64:
    """H of equation (40) from the images of a panel's four corners, in closed form (equations (42) to (46), corrected).

    corners_px: (4, 2) image pixels of the corners in the order of `panel_corners_px`.
    Returns 3x3 with h33 = 1. Raises ValueError where the quadrilateral is degenerate: corners that are not finite,
    two at one place, or three on a line as far as doubles can tell.
    Use `image_from_raster` to build H; this is its independent check and the better only when all that is
    known are four points.
    """
    corners = np.asarray(corners_px, dtype=np.float64)
    _check_no_three_on_a_line(corners)
    (u0, v0), (u1, v1), (u2, v2), (u3, v3) = corners.tolist()
    du1, dv1 = u1 - u2, v1 - v2
    du2, dv2 = u3 - u2, v3 - v2
    du3, dv3 = u0 - u1 + u2 - u3, v0 - v1 + v2 - v3
    determinant = du1 * dv2 - du2 * dv1
    g = (du3 * dv2 - du2 * dv3) / determinant
    h = (du1 * dv3 - du3 * dv1) / determinant
    return np.array(
        [
            [(u1 - u0 + g * u1) / width_px, (u3 - u0 + h * u3) / height_px, u0],
            [(v1 - v0 + g * v1) / width_px, (v3 - v0 + h * v3) / height_px, v0],
            [g / width_px, h / height_px, 1.0],
        ]
    )


def _check_no_three_on_a_line(corners_px: F64) -> None:
    """Raise ValueError where three of four corners (4, 2) are collinear or two coincide, within rounding."""
    size = float(np.abs(corners_px).max())
    if not math.isfinite(size):
        raise ValueError("the panel's corners are collinear in the image, or not finite: its homography is singular")
    scaled = corners_px / (size or 1.0)  # squares of 1e200 would leave float64
    for left_out in range(4):
        a, b, c = np.delete(scaled, left_out, axis=0)
        (ax, ay), (bx, by) = b - a, c - a
        # A corner is known to eps of the largest coordinate: so much of the sides' lengths can the area be off by.
        noise = 8 * np.finfo(np.float64).eps * (math.hypot(ax, ay) + math.hypot(bx, by))
        if abs(ax * by - ay * bx) <= noise:
            raise ValueError("three of the panel's corners are collinear in the image: its homography is singular")


def corners_in_front(image_from_stack: F64, raster: PlaneRaster) -> bool:
    """True where all four corners of a panel lie before the eye, so that its homography has one sign."""
    corners = np.column_stack([panel_corners_px(raster), np.ones(4)])
    depth_m = corners @ image_from_raster(image_from_stack, raster)[2]
    return bool((depth_m > 0.0).all())


def panel_from_image(image_from_stack: F64, raster: PlaneRaster) -> F64:
    """M_RPU (equation (47)): 3x3 panel pixels from an eye's image pixels; the inverse of the plane-induced homography.

    Built without a numerical inverse: the ray of an image pixel is cut with the panel's plane, so that it
    stays exact at grazing angles. Scaled so that its largest entry is 1.
    Raises ValueError for an eye in the panel's plane.
    """
    h = image_from_raster(image_from_stack, raster)
    adjugate = np.array([np.cross(h[:, 1], h[:, 2]), np.cross(h[:, 2], h[:, 0]), np.cross(h[:, 0], h[:, 1])])
    scale = np.abs(adjugate).max()
    # Below this the determinant is rounding error of the terms that h's last column was added up from.
    terms = np.abs(image_from_stack) @ np.abs([raster.x_m, raster.left_m, raster.top_m, 1.0])
    noise = 64 * np.finfo(np.float64).eps * float(terms @ np.abs(adjugate[2]))
    if not np.isfinite(scale) or scale == 0.0 or abs(adjugate[2] @ h[:, 2]) <= noise:
        raise ValueError("the eye lies in the panel's plane: its view of the panel is singular")
    result: F64 = adjugate / scale
    return result
