"""References of 50 digits (mpmath) for the optics. They share nothing with it but the definitions of the frames."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypedDict

from runtime.errors import MissingPart
from runtime.optics.stack import PanelStack
from runtime.records import F64

try:
    from mpmath import mp as mp
    from mpmath import mpf as mpf
except ImportError:
    raise MissingPart("mpmath is needed for the references: pip install mpmath") from None

mp.dps = 50
Vector = tuple[Any, Any, Any]  # of mpf


class Image(TypedDict):
    """An eye's image: what the projections of the optics take as keywords."""

    width_px: int
    height_px: int
    fov_deg: float


def vector(values: Sequence[float] | F64) -> Vector:
    """Floats as exact numbers."""
    return (mpf(float(values[0])), mpf(float(values[1])), mpf(float(values[2])))


def dot(a: Vector, b: Vector) -> Any:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def combine(a: Vector, factor: Any, b: Vector) -> Vector:
    """a + factor·b."""
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def unit(a: Vector) -> Vector:
    """A vector of length 1 in the same direction."""
    length = mp.sqrt(dot(a, a))
    return (a[0] / length, a[1] / length, a[2] / length)


@lru_cache(maxsize=256)
def axes(eye: Vector) -> tuple[Vector, Vector, Vector]:
    """Right, up and back of an eye that looks at the origin ((10)-(13)); on the vertical axis the limit from +x."""
    back = unit(eye)
    right = (mpf(0), mpf(1), mpf(0)) if eye[0] == 0 and eye[1] == 0 else unit((-eye[1], eye[0], mpf(0)))
    return right, cross(back, right), back


@lru_cache(maxsize=256)
def focal_px(width_px: int, fov_deg: float) -> Any:
    """Focal length of a picture of this width and horizontal field of view, pixels."""
    return mpf(width_px) / 2 / mp.tan(mp.radians(mpf(fov_deg)) / 2)


def ray(eye: Vector, u: Any, v: Any, *, width_px: int, height_px: int, fov_deg: float) -> Vector:
    """Direction, in the stack frame, of the ray through an image position."""
    right, up, back = axes(eye)
    focal = focal_px(width_px, fov_deg)
    forward = combine(combine((-back[0], -back[1], -back[2]), (u - mpf(width_px) / 2) / focal, right), 0, up)
    return combine(forward, -(v - mpf(height_px) / 2) / focal, up)


def image_position(eye: Vector, point: Vector, *, width_px: int, height_px: int, fov_deg: float) -> tuple[Any, Any]:
    """Where a point appears in the eye's image."""
    right, up, back = axes(eye)
    away = combine(point, -1, eye)
    depth = -dot(away, back)
    focal = focal_px(width_px, fov_deg)
    return focal * dot(away, right) / depth + mpf(width_px) / 2, -focal * dot(away, up) / depth + mpf(height_px) / 2


def hit(eye: Vector, direction: Vector, x_m: float) -> Vector:
    """Where a ray crosses the plane at x."""
    return combine(eye, (mpf(x_m) - eye[0]) / direction[0], direction)


def on_panel(eye: Vector, direction: Vector, stack: PanelStack, index: int) -> tuple[Any, Any]:
    """Where a ray crosses a panel, pixels (u, v)."""
    _, right, up = hit(eye, direction, stack.x_m[index])
    half = mpf("0.5")
    return (
        (right / mpf(stack.width_m) + half) * stack.width_px,
        (half - up / mpf(stack.height_m)) * stack.height_px,
    )


def jones_intensity(values: Sequence[float]) -> Any:
    """Panels between crossed polarizers by the product of their rotations; values in units of pi/2."""
    a, b = mpf(1), mpf(0)
    for value in values:
        angle = mpf(float(value)) * mp.pi / 2
        c, s = mp.cos(angle), mp.sin(angle)
        a, b = c * a - s * b, s * a + c * b
    return b * b


def phase(intensity: float, branch: int) -> Any:
    """The phase sum (units of pi/2) on a branch of Malus' law."""
    root = mp.asin(mp.sqrt(mpf(float(intensity)))) * 2 / mp.pi
    return root if branch == 1 else 2 - root


def distance(a: Any, b: Any) -> float:
    """|a - b| of a float and a reference, as a float."""
    return float(abs(mpf(float(a)) - b))
