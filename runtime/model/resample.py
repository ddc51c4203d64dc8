"""Axis-aligned resampling between rasters on parallel planes, as one eye sees them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.optics.stack import PlaneRaster
from runtime.optics.views import relative_scale_shift
from runtime.records import F64


def target_from_source(eye_m: ArrayLike, *, source: PlaneRaster, target: PlaneRaster) -> F64:
    """3x3: pixels of `target` hit by the eye's rays through pixels of `source`; both parallel to the panels."""
    scale, shift_m = relative_scale_shift(eye_m, from_x_m=source.x_m, to_x_m=target.x_m)
    across = np.array([[scale, 0.0, shift_m[0]], [0.0, scale, shift_m[1]], [0.0, 0.0, 1.0]])
    return target.raster_from_plane() @ across @ source.plane_from_raster()


def resample(
    image: NDArray[Any], *, image_from_result: F64, width_px: int, height_px: int, out: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Bilinear samples of an (h, w, C) image at the affine positions of a raster; edges repeated.

    image_from_result: 3x3, pixel centres at half-integers.
    """
    import cv2

    # OpenCV puts pixel centres at integers.
    matrix = image_from_result[:2].copy()
    matrix[:, 2] += image_from_result[:2, :2] @ (0.5, 0.5) - 0.5
    return cv2.warpAffine(
        image,
        matrix,
        (width_px, height_px),
        dst=out,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
