"""Keep a stereo picture within a comfortable depth."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from runtime.records import U8

WIDTH_PX = 192  # width at which disparities are measured
REACH_PX = 24  # largest disparity that is found, an eighth of the width
USUAL = (2.0, 98.0)  # percentiles that count as the farthest and the nearest content
FEWEST = 0.02  # share of pixels that need a disparity
SMALLEST = 0.25  # smallest size of the picture, as a fraction
BLOCK_PX = 5
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
