"""Calibration charts as arrays: black lines on white at the thirds of each eye's image (EyeReal, 2.3, figure S4)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from calib.viewpoints import Viewpoint
from runtime.optics.rpu import corners_in_front
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F64, U8

Kind = Literal["solved", "seed"]
LINE_PX = 10.0
WIDEST_FOV_DEG = 40.0  # horizontal, of the eyes' images, as the published code has it


def chart_fov_deg(viewpoint: Viewpoint, stack: PanelStack) -> float:
    """Horizontal field of view of a viewpoint's eye images: the published one, or, from afar, the display's width.

    The lines so stay on the panels wherever the viewer stands.
    """
    return min(WIDEST_FOV_DEG, float(np.degrees(2 * np.arctan(stack.width_m / 2 / (viewpoint.radius_cm / 100)))))


def line_picture(*, width_px: int, height_px: int) -> U8:
    """(h, w, 3) what an eye should see: lines of 10 pixels at the thirds of width and height."""
    u: F64 = np.arange(width_px, dtype=np.float64) + 0.5
    v: F64 = (np.arange(height_px, dtype=np.float64) + 0.5)[:, None]
    ink = np.maximum(_ink(u, width_px, 1.0), _ink(v, height_px, 1.0))
    return np.repeat(_white_less(ink)[..., None], 3, axis=2)


def eye_chart(viewpoint: Viewpoint, stack: PanelStack, *, side: int, index: int, ipd_m: float) -> U8:
    """(H, W) the EyeReal supplement's own chart: panel `index` alone shows the lines to one eye (0: left, 1: right).

    Panel pixels look up the eye's image through H (EyeReal, (40)), so the lines are straight, and at the thirds, only
    from that eye's place. Raises ValueError where a corner of the panel is behind the eye.
    """
    raster = stack.panel(index)
    projection = image_from_stack(
        viewpoint.eyes_m(ipd_m)[side],
        width_px=stack.width_px,
        height_px=stack.height_px,
        fov_deg=chart_fov_deg(viewpoint, stack),
    )
    if not corners_in_front(projection, raster):
        raise ValueError(f"panel {index} is not before the eye at {viewpoint.name}")
    h = image_from_raster(projection, raster)
    x, y = np.arange(stack.width_px) + 0.5, (np.arange(stack.height_px) + 0.5)[:, None]
    weight = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    u, v = ((h[row, 0] * x + h[row, 1] * y + h[row, 2]) / weight for row in (0, 1))
    # Image pixels in one panel pixel, across each family of lines: what softens the edge by one pixel there.
    per_pixel_u = np.hypot(h[0, 0] - u * h[2, 0], h[0, 1] - u * h[2, 1]) / weight
    per_pixel_v = np.hypot(h[1, 0] - v * h[2, 0], h[1, 1] - v * h[2, 1]) / weight
    ink = np.maximum(_ink(u, stack.width_px, per_pixel_u), _ink(v, stack.height_px, per_pixel_v))
    return _white_less(ink)


def alone(picture: U8, stack: PanelStack, *, index: int) -> U8:
    """(N, H, W, 4) layers in which one panel shows a grey (H, W) picture and the others turn no light."""
    layers = np.zeros((stack.count, *picture.shape, 4), np.uint8)
    layers[..., 3] = 255
    layers[index, ..., :3] = picture[..., None]
    return layers


def _ink(position: F64, length_px: int, softness_px: F64 | float) -> F64:
    """Share of a pixel that lines at the thirds of a length cover."""
    distance = np.minimum(np.abs(position - length_px / 3), np.abs(position - 2 * length_px / 3))
    return np.clip((LINE_PX / 2 - distance) / softness_px + 0.5, 0.0, 1.0)


def _white_less(ink: F64) -> U8:
    return np.rint(255 * (1 - ink)).astype(np.uint8)
