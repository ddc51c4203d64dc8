"""Keep a stereo picture within a comfortable depth."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from runtime.content.base import View
from runtime.optics.stack import PlaneRaster
from runtime.records import F64, U8

WIDTH_PX = 192  # width at which disparities are measured
REACH_PX = 24  # largest disparity that is found, an eighth of the width
USUAL = (2.0, 98.0)  # percentiles that count as the farthest and the nearest content
FEWEST = 0.02  # share of pixels that need a disparity
SMALLEST = 0.25  # smallest size of the picture, as a fraction
BLOCK_PX = 5
MEASURED_EVERY = 3  # pictures after which the depth of a moving picture is measured again
FOLLOWS = 0.2  # weight of a new measurement of a moving picture's depth
DETAIL = 40.0  # Sobel gradient along a row at which a pixel's disparity counts


def disparities(left: U8, right: U8) -> tuple[float, float] | None:
    """Return the farthest and nearest disparity of two RGB views, as fractions of their width.
    Disparities are positive in front of the screen. None if the views have too little in common.
    """
    step = max(1, left.shape[1] // (4 * WIDTH_PX))  # averaging all pixels of a large picture would take long
    height = max(BLOCK_PX, round(WIDTH_PX * left.shape[0] / left.shape[1]))
    # A margin on both sides lets disparities of both signs be found up to the edges.
    grey = [
        np.pad(
            cv2.cvtColor(
                cv2.resize(view[::step, ::step], (WIDTH_PX, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY
            ),
            ((0, 0), (REACH_PX, REACH_PX)),
            mode="edge",
        )
        for view in (left, right)
    ]
    matcher: Any = cv2.StereoSGBM.create(
        minDisparity=-REACH_PX,
        numDisparities=2 * REACH_PX // 16 * 16,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        uniquenessRatio=15,
    )
    found = matcher.compute(*grey)[:, REACH_PX:-REACH_PX] / 16.0
    has_detail = np.abs(cv2.Sobel(grey[0], cv2.CV_32F, 1, 0)[:, REACH_PX:-REACH_PX]) > DETAIL
    known = found[(found > -REACH_PX) & has_detail]
    if known.size < FEWEST * found.size:
        return None
    far, near = np.percentile(known, USUAL) / WIDTH_PX
    return float(far), float(near)


def adjusted(far_m: float, near_m: float, most_m: float) -> tuple[float, float]:
    """Return how far to move the right view to the right, in metres, and the scale of both. Disparities
    of the farthest and nearest content, positive in front, become at most `most_m` of either sign.
    """
    if near_m - far_m > 2 * most_m:
        scale = max(2 * most_m / (near_m - far_m), SMALLEST)
        return scale * (near_m + far_m) / 2, scale
    return max(near_m - most_m, 0.0) + min(far_m + most_m, 0.0), 1.0


class DepthLimit:
    """Keeps a sequence of stereo pictures within a comfortable depth."""

    def __init__(self, *, follows: bool) -> None:
        """Create a limit that `follows` the depth of a film's pictures slowly, or measures each picture by itself."""
        self._follows = follows
        self._depths: tuple[float, float] | None = None  # farthest and nearest disparity, as fractions of the width
        self._measured: int | None = None  # number of the picture whose depth was measured last

    def moved(
        self, from_view: F64 | None, view: View, *, number: int, pictures: list[U8], screen: PlaneRaster
    ) -> F64 | None:
        """Return the homography `from_view` from a view's pixels to those of a picture, moved to where the
        picture of this `number` is comfortable.
        """
        if not view.comfort_deg or len(pictures) != 2:
            self._depths = self._measured = None
            return from_view
        self._measure(pictures, number)
        if from_view is None or self._depths is None:
            return from_view
        width_m = screen.width_px * screen.pitch_u_m
        most_m = np.radians(view.comfort_deg) * max(view.eye_m[0], 0.0)
        far, near = self._depths
        shift_m, scale = adjusted(far * width_m, near * width_m, most_m)
        middle = screen.width_px / 2, screen.height_px / 2
        moved_px = (view.side - 0.5) * shift_m / screen.pitch_u_m
        picture_from_plane = np.array(
            [
                [1 / scale, 0, middle[0] - (middle[0] + moved_px) / scale],
                [0, 1 / scale, middle[1] * (1 - 1 / scale)],
                [0, 0, 1],
            ]
        )
        return np.asarray(picture_from_plane @ from_view)

    def _measure(self, views: list[U8], number: int) -> None:
        last, every = self._measured, MEASURED_EVERY if self._follows else 1
        if last is not None and last <= number < last + every:
            return
        found, self._measured = disparities(*views), number
        if self._follows and self._depths is not None:
            found = found or self._depths
            far, near = ((1 - FOLLOWS) * old + FOLLOWS * new for old, new in zip(self._depths, found))
            found = far, near
        self._depths = found
