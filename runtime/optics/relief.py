"""Depth of the content (its relief), and the motion on the panels that it causes when the eyes move.

Let o be the point midway between the eyes. From o, a content point at depth x is seen through a point c on the middle
panel's plane (x = r). Measure c from the plane's origin. Let b = (x - r) / (o_x - x) be the relief, n the new midpoint
between the eyes, and k = (o_x - r) / (n_x - r). The content now seen through c was previously seen through

    c + b·((k·n - o) + (1 - k)·c)        (in y and z only).

A point on the middle panel has relief 0: content there does not move; `alignment` treats all content this way. The ray
from the old midpoint through that point gives the pixel on each of the other panels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, Parallax

WIDEST_PX = 480  # columns of a relief; more of them do not give finer outlines
RIM_PX = 2  # relief pixels by which nearer content is dilated, so that its outline moves with it
COARSE_RIM_PX = 1  # the same for a coarse raster, whose relief has fewer pixels

Pixels = NDArray[np.floating[Any]]


def block_px(width_px: int) -> int:
    """Return the side of the block that one relief pixel covers, in pixels of any raster.

    width_px: columns of the full raster. Blocks of a coarse raster have the same number of pixels, each larger.
    """
    return -(-width_px // WIDEST_PX)


def relief_of(nearness: Sequence[F32], *, distance_m: Sequence[float], rim_px: int = RIM_PX) -> F32:
    """Combine both eyes' depth into one (h, w) relief. Each pixel takes the value that is farther from 0.

    nearness: for each eye, the (h, w) inverse distances along x in 1/m; 0 for the background, whose relief is 0.
    distance_m: each eye's distance from the middle panel. rim_px: dilation of nearer content, in relief pixels.
    """
    rim = np.ones((2 * rim_px + 1,) * 2, np.uint8)
    reliefs = []
    for inverse, eye_m in zip(nearness, distance_m, strict=True):
        kept = cv2.dilate(inverse, rim)
        reliefs.append(np.where(kept > 0.0, kept * np.float32(eye_m) - np.float32(1), np.float32(0)))
    left, right = reliefs
    return np.ascontiguousarray(np.where(np.abs(left) > np.abs(right), left, right), np.float32)


def parallax(stack: PanelStack, *, old_m: F64, new_m: F64) -> Parallax | None:
    """Return the content's motion on the panels when the eyes' midpoint (3,) moves, in frame `stack`.

    Returns None if there is no middle panel (an even number of panels) or no movement.
    """
    if stack.count % 2 == 0 or np.array_equal(old_m, new_m):
        return None
    middle = stack.panel(stack.count // 2)
    old, new = old_m[0] - middle.x_m, new_m[0] - middle.x_m
    k = old / new
    drift_m, growth = k * new_m[1:] - old_m[1:], 1.0 - k
    places, weights = [], []
    for n in range(stack.count):
        raster = stack.panel(n)
        # Project from the panel to the middle one along the new midpoint's rays.
        scale = (new_m[0] - middle.x_m) / (new_m[0] - raster.x_m)
        matrix = np.diag([scale * raster.pitch_u_m / middle.pitch_u_m, scale * raster.pitch_v_m / middle.pitch_v_m, 1])
        y_m, z_m = new_m[1:] + (np.array([raster.left_m, raster.top_m]) - new_m[1:]) * scale
        matrix[0, 2], matrix[1, 2] = (y_m - middle.left_m) / middle.pitch_u_m, (middle.top_m - z_m) / middle.pitch_v_m
        places.append(matrix)
        weights.append((old_m[0] - raster.x_m) / (old_m[0] - middle.x_m) * middle.pitch_u_m / raster.pitch_u_m)
    drift_px = (
        float(drift_m[0] + growth * middle.left_m) / middle.pitch_u_m,
        -float(drift_m[1] + growth * middle.top_m) / middle.pitch_v_m,
    )
    return Parallax(drift_px, float(growth), tuple(places), tuple(map(float, weights)))


@dataclass(frozen=True, slots=True)
class Displacement:
    """Correction of a panel's alignment for content off the middle panel."""

    relief: F32
    drift_px: tuple[float, float]
    growth: float
    middle_from_shown: F64
    weight: float

    def at(self, columns: Pixels, rows: Pixels, *, size_px: tuple[int, int]) -> tuple[F32, F32]:
        """Return the displacements, right and down, of pixel centres: two (rows, columns) in panel pixels."""
        scale_u, scale_v = self.middle_from_shown[0, 0], self.middle_from_shown[1, 1]
        u = columns * scale_u + self.middle_from_shown[0, 2]
        v = rows * scale_v + self.middle_from_shown[1, 2]
        height, width = self.relief.shape
        low_u, right = _between_centres(u * (width / size_px[0]), width)
        low_v, down = _between_centres(v * (height / size_px[1]), height)
        lines = (
            self.relief[low_v] * (1 - down)[:, None] + self.relief[np.minimum(low_v + 1, height - 1)] * down[:, None]
        )
        b = lines[:, low_u] * (1 - right) + lines[:, np.minimum(low_u + 1, width - 1)] * right
        b *= np.float32(self.weight)
        across = np.asarray(self.drift_px[0] + self.growth * u, np.float32)
        along = np.asarray(self.drift_px[1] + self.growth * v, np.float32)
        return b * across, b * along[:, None]


def displacement(relief: F32 | None, parallax: Parallax | None, panel: int) -> Displacement | None:
    """Return a panel's displacement, or None if there is no relief or no movement."""
    if relief is None or parallax is None:
        return None
    return Displacement(
        relief, parallax.drift_px, parallax.growth, parallax.middle_from_shown[panel], parallax.weights[panel]
    )


def _between_centres(place: Pixels, count: int) -> tuple[NDArray[np.intp], F32]:
    """Return the last of `count` pixel centres before each place, and the clamped distance past it."""
    inside = np.clip(place - 0.5, 0.0, count - 1.0)
    low = np.floor(inside)
    return low.astype(np.intp), (inside - low).astype(np.float32)
