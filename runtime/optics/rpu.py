"""Reverse perspective uniform: panel pixels from an eye's image pixels (supplement, (40)-(47)).

The supplement's misprints are listed and corrected in docs/mathematics.md.
"""

from __future__ import annotations

import numpy as np

from runtime.optics.stack import PlaneRaster
from runtime.optics.views import image_from_raster
from runtime.records import F64


def panel_from_image(image_from_stack: F64, raster: PlaneRaster) -> F64:
    """Return M_RPU (equation (47)), the 3x3 homography to panel pixels from image pixels.

    It is computed from the adjugate, which stays exact at grazing angles, and scaled so that its largest entry is 1.
    Raises ValueError for an eye in the panel's plane.
    """
    h = image_from_raster(image_from_stack, raster)
    adjugate = np.array([np.cross(h[:, 1], h[:, 2]), np.cross(h[:, 2], h[:, 0]), np.cross(h[:, 0], h[:, 1])])
    scale = np.abs(adjugate).max()
    # A determinant below this is only the rounding error of the sum in h's last column.
    terms = np.abs(image_from_stack) @ np.abs([raster.x_m, raster.left_m, raster.top_m, 1.0])
    noise = 64 * np.finfo(np.float64).eps * float(terms @ np.abs(adjugate[2]))
    if not np.isfinite(scale) or scale == 0.0 or abs(adjugate[2] @ h[:, 2]) <= noise:
        raise ValueError("the eye is in the panel's plane, so its view of the panel is singular")
    result: F64 = adjugate / scale
    return result
