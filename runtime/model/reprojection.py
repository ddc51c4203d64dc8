"""Where panels' pixels lie on each other, as an eye sees them in line; and the panels' names and units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from runtime.model.resample import target_from_source
from runtime.model.targets import FULL, SUBCODE
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen, layer_pixels_from_seen
from runtime.records import F64

EYES = (0, 1)  # left, right
REAR, CENTRE, FRONT = 0, 1, 2
OUTER = (REAR, FRONT)
START = FULL // 2  # of an outer panel, sixteenths of a code: the middle of its range
NEUTRAL = (START + SUBCODE // 2) // SUBCODE  # the same in 8-bit codes, rounded as what is shown is
MAX_SPREAD_PX = 8.0
LEAST_SPREAD_PX = 0.5  # of an outer panel's picture: below, care for unsure eyes costs more time than it gains


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


def spreads(rasters: Sequence[PlaneRaster], eyes_m: F64, *, eye_sigma_mm: float) -> dict[int, tuple[float, float]]:
    """Per outer panel whose pixels move by enough to be felt for eyes (2, 3) that err by so much: right and down."""
    eye_x_m, centre_x_m = eyes_m[:, 0].mean(), rasters[CENTRE].x_m
    found = {}
    for n in OUTER:
        raster = rasters[n]
        moved_m = eye_sigma_mm / 1e3 * abs(raster.x_m - centre_x_m) / (eye_x_m - centre_x_m)
        spread = min(moved_m / raster.pitch_u_m, MAX_SPREAD_PX), min(moved_m / raster.pitch_v_m, MAX_SPREAD_PX)
        if max(spread) >= LEAST_SPREAD_PX:
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
