"""Reverse perspective uniform (RPU), the map from pixels in an eye's image to panel pixels.

The map is defined by equations (40)-(47) of the supplement. Their misprints are corrected in docs/mathematics.md.
"""

from __future__ import annotations

import numpy as np

from runtime.optics.stack import PlaneRaster
from runtime.optics.views import image_from_raster
from runtime.records import F64


def panel_from_image(image_from_stack: F64, raster: PlaneRaster) -> F64:
    """Return M_RPU (equation (47)), the 3x3 homography from image pixels to panel pixels; its largest
    entry has magnitude 1. Computed as an adjugate, which stays accurate at grazing angles. Raises ValueError if the eye
    is in the panel's plane or the projection is not finite.
    """
    h = image_from_raster(image_from_stack, raster)
    adjugate = np.array([np.cross(h[:, 1], h[:, 2]), np.cross(h[:, 2], h[:, 0]), np.cross(h[:, 0], h[:, 1])])
    scale = np.abs(adjugate).max()
    if not np.isfinite(scale):
        raise ValueError("the projection from the panel to the eye's image is not finite")
    # A determinant below `noise` may be nothing more than rounding error from the sum in the last column of h.
    terms = np.abs(image_from_stack) @ np.abs([raster.x_m, raster.left_m, raster.top_m, 1.0])
    noise = 64 * np.finfo(np.float64).eps * float(terms @ np.abs(adjugate[2]))
    if scale == 0.0 or abs(adjugate[2] @ h[:, 2]) <= noise:
        raise ValueError("the eye is in the panel's plane, so its view of the panel is singular")
    result: F64 = adjugate / scale
    return result
