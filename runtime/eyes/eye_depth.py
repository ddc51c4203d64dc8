"""From eyes in a picture and a depth image to points in the sensor's frame."""

from __future__ import annotations

import numpy as np

from runtime.records import F64, U16, Intrinsics

M_PER_MM = 1e-3
GROW = (1.0, 1.8, 3.0)  # windows that are tried until one holds enough measurements
ENOUGH = 0.2  # share of a window that must be measured
FACE_DEPTH_M = 0.12  # what belongs to one face is within this of its median


def depth_at(
    depth_mm: U16, point: F64, *, radius: float, nearest_m: float, farthest_m: float, expected_m: float | None = None
) -> float | None:
    """Robust depth (m) around a point in the depth image's continuous pixels; None where nothing is measured.

    Holes (0) and what is out of range do not count; a larger window is tried where too little is left. The
    median is taken twice, the second time of what is near the first: an edge of the head, with the wall behind
    it, does not pull. `expected_m`: what is farther than a face's depth from it belongs to something else.
    """
    height, width = depth_mm.shape
    for grow in GROW:
        r = max(1.5, radius * grow)
        x0, x1 = max(int(point[0] - r), 0), min(int(point[0] + r) + 1, width)
        y0, y1 = max(int(point[1] - r), 0), min(int(point[1] + r) + 1, height)
        if x0 >= x1 or y0 >= y1:
            return None
        values = depth_mm[y0:y1, x0:x1].astype(np.float64).ravel() * M_PER_MM
        good = values[(values >= nearest_m) & (values <= farthest_m)]
        if expected_m is not None:
            good = good[np.abs(good - expected_m) <= FACE_DEPTH_M]
        if good.size >= max(3.0, ENOUGH * values.size):
            median = float(np.median(good))
            near = good[np.abs(good - median) <= FACE_DEPTH_M / 4]
            return float(np.median(near)) if near.size else median
    return None


def point_from_pixel(pixel: F64, depth_m: float, intrinsics: Intrinsics) -> F64:
    """(3,) in the `sensor` frame from a continuous pixel and the distance along the camera's axis."""
    i = intrinsics
    x, y = (pixel[0] - i.cx_px) / i.fx_px, (pixel[1] - i.cy_px) / i.fy_px
    return np.array([x * depth_m, y * depth_m, depth_m])
