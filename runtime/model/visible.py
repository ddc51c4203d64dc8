"""Which part of each panel the two eyes look through: rays that cross every panel. The rest needs no solving."""

from __future__ import annotations

from math import ceil, floor

import numpy as np

from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.optics.views import relative_scale_shift
from runtime.records import F64

PAD_PX = 2
ALIGN_PX = 8  # boxes begin and end at multiples of this, so that a half or a quarter of them is whole
LEAST_PX = 32


def visible_boxes(eyes_m: F64, stack: PanelStack) -> tuple[PixelRect, ...]:
    """For each panel the pixels on rays of either eye (2, 3) that cross every panel, a little padded.

    Where an eye sees nothing through all panels, a small box in the middle: there is nothing to solve.
    """
    middle = stack.count // 2
    half = np.array([stack.width_m, stack.height_m]) / 2
    lows, highs = [], []
    for eye_m in eyes_m:
        per_panel = [
            [corner * scale + shift for corner in (-half, half)]
            for scale, shift in (
                relative_scale_shift(eye_m, from_x_m=x_m, to_x_m=stack.x_m[middle]) for x_m in stack.x_m
            )
        ]
        lows.append(np.max([low for low, _ in per_panel], axis=0))
        highs.append(np.min([high for _, high in per_panel], axis=0))
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    boxes = []
    for x_m in stack.x_m:
        corners = [
            corner * scale + shift
            for eye_m in eyes_m
            for scale, shift in (relative_scale_shift(eye_m, from_x_m=stack.x_m[middle], to_x_m=x_m),)
            for corner in (low, high)
        ]
        boxes.append(_box(np.min(corners, axis=0), np.max(corners, axis=0), stack))
    return tuple(boxes)


def _box(low_m: F64, high_m: F64, stack: PanelStack) -> PixelRect:
    u0, u1 = _span(low_m[0] / stack.width_m + 0.5, high_m[0] / stack.width_m + 0.5, stack.width_px)
    v0, v1 = _span(0.5 - high_m[1] / stack.height_m, 0.5 - low_m[1] / stack.height_m, stack.height_px)
    return PixelRect(u0, v0, u1, v1)


def _span(low: float, high: float, size: int) -> tuple[int, int]:
    first, last = max(0, floor(low * size) - PAD_PX), min(size, ceil(high * size) + PAD_PX)
    first, last = first // ALIGN_PX * ALIGN_PX, min(size, -(-last // ALIGN_PX) * ALIGN_PX)
    least = min(LEAST_PX, size)
    if last - first < least:
        first = min(max(0, (first + last - least) // 2), size - least)
        last = first + least
    return first, last
