"""Warp pictures with a known projection to a view's raster."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.content.base import View
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PlaneRaster, between_pixel_centres
from runtime.optics.views import image_from_raster
from runtime.records import F64, U8


def rgba_from_rgb(rgb: U8) -> U8:
    """Convert an RGB picture (h, w, 3) to opaque RGBA (h, w, 4). OpenCV warps RGBA in half the time."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA))


def image_from_view(image_from_stack: F64, pixels_from_stack: F64) -> F64 | None:
    """Return the 3x3 homography from a view's pixels to those of a picture shown on the plane x = 0,
    given 3x4 projections. Any other plane gives the same result for one eye position. None if the view's eye is in the
    plane.
    """
    # This raster's pixel coordinates are metres along y (u) and -z (v).
    plane = PlaneRaster(x_m=0.0, left_m=0.0, top_m=0.0, pitch_u_m=1.0, pitch_v_m=1.0, width_px=1, height_px=1)
    plane_from_view = plane_from_pixels(pixels_from_stack, plane)
    return None if plane_from_view is None else image_from_raster(image_from_stack, plane) @ plane_from_view


def plane_from_pixels(pixels_from_stack: F64, plane: PlaneRaster) -> F64 | None:
    """Return the 3x3 homography from a view's to a plane's pixels, or None if its eye is in the plane."""
    try:
        return panel_from_image(pixels_from_stack, plane)
    except ValueError:
        return None


def reduction(picture_from_view: F64, view: View) -> int:
    """Return how many times to halve a picture before warping it, to limit aliasing. Neighbouring pixels
    in the middle of the view are then less than 1.5 picture pixels apart along an axis.
    """
    middle = np.array([view.width_px, view.height_px]) / 2 + np.array([[0, 0], [1, 0], [0, 1]])
    mapped = cv2.perspectiveTransform(middle[None], picture_from_view)[0]
    steps = np.linalg.norm(mapped[1:] - mapped[0], axis=1)
    return int(np.clip(np.floor(np.log2(max(float(steps.min()), 1e-9) / 1.5) + 1), 0, 8))


class WarpedPicture:
    """Picture that can be warped to a view's raster. Keeps reduced copies to limit aliasing."""

    def __init__(self, rgba: U8, *, background: tuple[float, float, float]) -> None:
        self._levels = [np.ascontiguousarray(rgba)]
        self._border = (*(round(value * 255) for value in background), 0)
        self._out: dict[tuple[int, int, int], U8] = {}

    def warped(self, picture_from_view: F64 | None, view: View) -> U8:
        """Return the picture warped to the view's raster, RGBA (h, w, 4), by a homography (3, 3) from the
        view's pixels. Pixels outside the picture, or all without a homography, have the background's colour and alpha
        0. The next call for the same size and side overwrites the array.
        """
        key = (view.width_px, view.height_px, view.side)
        if key not in self._out:
            self._out[key] = np.empty((view.height_px, view.width_px, 4), np.uint8)
        out = self._out[key]
        if picture_from_view is None:
            out[:] = self._border
            return out
        picture, shrink = self._level(reduction(picture_from_view, view))
        matrix = between_pixel_centres(np.diag([*shrink, 1.0]) @ picture_from_view)
        cv2.warpPerspective(
            picture,
            matrix,
            (view.width_px, view.height_px),
            dst=out,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=self._border,
        )
        return out

    def _level(self, level: int) -> tuple[U8, tuple[float, float]]:
        while len(self._levels) <= level and min(self._levels[-1].shape[:2]) > 1:
            height, width = self._levels[-1].shape[:2]
            size = ((width + 1) // 2, (height + 1) // 2)
            self._levels.append(np.asarray(cv2.resize(self._levels[-1], size, interpolation=cv2.INTER_AREA)))
        chosen = self._levels[min(level, len(self._levels) - 1)]
        full = self._levels[0]
        return chosen, (chosen.shape[1] / full.shape[1], chosen.shape[0] / full.shape[0])
