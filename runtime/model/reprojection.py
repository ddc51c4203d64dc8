"""Where panels lie on each other, as an eye sees them in line, and what is seen through all; panels' names, units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, floor

import numpy as np

from runtime.model.resample import target_from_source
from runtime.model.targets import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen, layer_pixels_from_seen
from runtime.optics.views import relative_scale_shift
from runtime.records import F64

EYES = (0, 1)  # left, right
REAR, CENTRE, FRONT = 0, 1, 2
OUTER = (REAR, FRONT)
START = FULL // 2  # of an outer panel, sixteenths of a code: the middle of its range
NEUTRAL = (START + SUBCODE // 2) // SUBCODE  # the same in 8-bit codes, rounded as what is shown is
MAX_SPREAD_PX = 8.0
LEAST_SPREAD_PX = 0.5  # of an outer panel's picture: below, care for unsure eyes costs more time than it gains
PAD_PX = 2  # of what is visible
ALIGN_PX = 8  # boxes begin and end at multiples of this, so that a half or a quarter of them is whole
LEAST_PX = 32


def reprojection(stack: PanelStack, rasters: Sequence[PlaneRaster], eye_m: F64, *, of: int, on: int) -> F64:
    """3x3, last entry 1: panel `of`'s pixels from panel `on`'s, as an eye (3,) sees them in line; one is the centre.

    A scale and a shift, but where panels are tilted (`optics.tilt`).
    """
    source, target = rasters[on], rasters[of]
    matrix = target_from_source(eye_m, source=source, target=target)
    if stack.tilt is not None:
        if of == CENTRE:
            back: F64 = np.linalg.inv(coarse_layer_from_seen(stack, on, eye_m)).astype(np.float64)
            matrix = matrix @ layer_pixels_from_seen(source, back)
        else:
            matrix = layer_pixels_from_seen(target, coarse_layer_from_seen(stack, of, eye_m)) @ matrix
        matrix /= matrix[2, 2]
    return matrix


def spreads(
    rasters: Sequence[PlaneRaster], eyes_m: F64, *, eye_sigma_mm: float, reduction: int = 1
) -> dict[int, tuple[float, float]]:
    """Per outer panel whose pixels move by enough to be felt for eyes (2, 3) that err by so much: right and down.

    reduction: how many times coarser the rasters are than the panels.
    """
    eye_x_m, centre_x_m = eyes_m[:, 0].mean(), rasters[CENTRE].x_m
    found = {}
    for n in OUTER:
        raster = rasters[n]
        moved_m = eye_sigma_mm / 1e3 * abs(raster.x_m - centre_x_m) / (eye_x_m - centre_x_m)
        spread = min(moved_m / raster.pitch_u_m, MAX_SPREAD_PX), min(moved_m / raster.pitch_v_m, MAX_SPREAD_PX)
        if max(spread) * reduction >= LEAST_SPREAD_PX:
            found[n] = spread
    return found


def coarser(raster: PlaneRaster, reduction: int) -> PlaneRaster:
    """The same rectangle in fewer pixels."""
    width, height = max(1, raster.width_px // reduction), max(1, raster.height_px // reduction)
    return replace(
        raster,
        pitch_u_m=raster.pitch_u_m * raster.width_px / width,
        pitch_v_m=raster.pitch_v_m * raster.height_px / height,
        width_px=width,
        height_px=height,
    )


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
