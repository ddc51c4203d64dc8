"""References of 50 digits (mpmath) for the optics: vectors are numpy arrays of mpf."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from mpmath import mp as mp
from mpmath import mpf as mpf

from runtime.optics.stack import PanelStack
from runtime.records import F64

mp.dps = 50


def vector(values: Sequence[float] | F64) -> Any:
    """(3,) floats as exact numbers."""
    return np.array([mpf(float(value)) for value in values], dtype=object)


def unit(a: Any) -> Any:
    """A vector of length 1 in the same direction."""
    return a / mp.sqrt(a @ a)


def axes(eye: Any) -> tuple[Any, Any, Any]:
    """Right, up and back axes of an eye ((10)-(13)); on the vertical axis the limit from +x."""
    back = unit(eye)
    right = vector([0, 1, 0]) if eye[0] == 0 and eye[1] == 0 else unit(np.array([-eye[1], eye[0], mpf(0)]))
    return right, np.cross(back, right), back


def _focal_px(width_px: int, fov_deg: float) -> Any:
    return mpf(width_px) / 2 / mp.tan(mp.radians(mpf(fov_deg)) / 2)


def ray(eye: Any, u: Any, v: Any, *, width_px: int, height_px: int, fov_deg: float) -> Any:
    """Direction, in the stack frame, of the ray through an image position."""
    right, up, back = axes(eye)
    focal = _focal_px(width_px, fov_deg)
    return (u - mpf(width_px) / 2) / focal * right - (v - mpf(height_px) / 2) / focal * up - back


def image_position(eye: Any, point: Any, *, width_px: int, height_px: int, fov_deg: float) -> tuple[Any, Any]:
    """Where a point appears in the eye's image, pixels."""
    right, up, back = axes(eye)
    away = point - eye
    scale = _focal_px(width_px, fov_deg) / -(away @ back)
    return scale * (away @ right) + mpf(width_px) / 2, -scale * (away @ up) + mpf(height_px) / 2


def hit(eye: Any, direction: Any, x_m: float) -> Any:
    """Where a ray crosses the plane at x."""
    return eye + (mpf(x_m) - eye[0]) / direction[0] * direction


def on_panel(eye: Any, direction: Any, stack: PanelStack, index: int) -> tuple[Any, Any]:
    """Where a ray crosses a panel, pixels (u, v)."""
    _, right, up = hit(eye, direction, stack.x_m[index])
    half = mpf("0.5")
    return (right / mpf(stack.width_m) + half) * stack.width_px, (half - up / mpf(stack.height_m)) * stack.height_px


def distance(a: Any, b: Any) -> float:
    """|a - b| of a float and a reference, as a float."""
    return float(abs(mpf(float(a)) - b))
