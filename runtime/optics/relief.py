"""Relief, which is the content's depth relative to the middle panel, and its effect as the eyes move.

Let o be the midpoint between the eyes, and x = r the plane of the middle panel. Seen from o, a content point at depth x
appears at a point c on this plane, measured from the plane's origin. The content point's relief is b = (x - r) / (o_x -
x). When the midpoint moves to n, the content that now appears at c previously appeared at

    c + b·((k·n - o) + (1 - k)·c),    k = (o_x - r) / (n_x - r)        (in y and z only).

Content on the middle panel has relief 0 and does not move; `alignment` treats all content as if it were there. On every
other panel, the corresponding pixel is where the ray from the old midpoint through the previous point on the middle
panel crosses that panel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, Parallax

WIDEST_PX = 480  # maximum number of columns in a relief; more columns would not give finer outlines
RIM_PX = 2  # relief pixels that nearer content is dilated by, so that its outline moves with it
COARSE_RIM_PX = 1  # RIM_PX for coarse rasters, whose reliefs have fewer pixels


def block_px(width_px: int) -> int:
    """Return the side of a relief pixel's block in raster pixels: the same number on a coarse raster."""
    return -(-width_px // WIDEST_PX)


def relief_of(nearness: Sequence[F32], *, distance_m: Sequence[float], rim_px: int = RIM_PX) -> F32:
    """Combine the depth seen by all eyes into one (h, w) relief: for each pixel, that with the larger
    magnitude.
    `nearness` are inverse distances along x in 1/m, 0 for the background, and `distance_m` each eye's distance from the
    middle panel. Nearer content is dilated by `rim_px` relief pixels. Relief that is not finite becomes 0.
    """
    rim = np.ones((2 * rim_px + 1,) * 2, np.uint8)
    reliefs = []
    for inverse, eye_m in zip(nearness, distance_m, strict=True):
        kept = cv2.dilate(inverse, rim)
        reliefs.append(np.where(kept > 0.0, kept * np.float32(eye_m) - np.float32(1), np.float32(0)))
    larger = reliefs[-1]
    for relief in reversed(reliefs[:-1]):
        larger = np.where(np.abs(relief) > np.abs(larger), relief, larger)
    return np.ascontiguousarray(np.where(np.isfinite(larger), larger, 0.0), np.float32)


def parallax(stack: PanelStack, *, old_m: F64, new_m: F64) -> Parallax | None:
    """Return how the content moves when the midpoint between the eyes moves from `old_m` to `new_m`, in
    frame `stack`. None if it has not moved, or if the number of panels is even.
    """
    if stack.count % 2 == 0 or np.array_equal(old_m, new_m):
        return None
    middle = stack.panel(stack.count // 2)
    old, new = old_m.tolist(), new_m.tolist()
    old_x_m, new_x_m = old[0] - middle.x_m, new[0] - middle.x_m
    k = old_x_m / new_x_m
    growth = 1.0 - k
    places, weights = [], []
    for n in range(stack.count):
        raster = stack.panel(n)
        places.append(raster.to_from(middle, new))
        weights.append((old[0] - raster.x_m) / old_x_m * middle.pitch_u_m / raster.pitch_u_m)
    drift_px = (
        (k * new[1] - old[1] + growth * middle.left_m) / middle.pitch_u_m,
        -(k * new[2] - old[2] + growth * middle.top_m) / middle.pitch_v_m,
    )
    return Parallax(drift_px, growth, tuple(places), tuple(weights))
