"""Slow references in plain Python floats: no numpy, no mathematics of the product, one ray at a time."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

from runtime.optics.stack import PanelStack

Vector = tuple[float, float, float]


def subtract(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def add_scaled(a: Vector, b: Vector, factor: float) -> Vector:
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def dot(a: Vector, b: Vector) -> float:
    return math.fsum(x * y for x, y in zip(a, b, strict=True))


def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def unit(a: Vector) -> Vector:
    length = math.sqrt(dot(a, a))
    return (a[0] / length, a[1] / length, a[2] / length)


def eye_axes(eye: Vector) -> tuple[Vector, Vector, Vector]:
    """Right (parallel to the ground), up and gaze of an eye that looks at the origin; not for the vertical axis."""
    gaze = unit((-eye[0], -eye[1], -eye[2]))
    right = unit(cross(gaze, (0.0, 0.0, 1.0)))
    return right, cross(right, gaze), gaze


def ray(eye: Vector, u: float, v: float, *, width: int, height: int, fov_deg: float) -> Vector:
    """Direction in the stack frame of the ray through image position (u, v)."""
    right, up, gaze = eye_axes(eye)
    half_width = math.tan(math.radians(fov_deg / 2))
    x = (2 * u / width - 1) * half_width
    y = (1 - 2 * v / height) * half_width * height / width
    return add_scaled(add_scaled(gaze, right, x), up, y)


def hit_plane(eye: Vector, direction: Vector, x: float) -> Vector:
    """Point where a ray crosses the plane at x."""
    return add_scaled(eye, direction, (x - eye[0]) / direction[0])


def panel_pixel(point: Vector, *, width_m: float, height_m: float, width: int, height: int) -> tuple[float, float]:
    """Panel position (u, v) of a point on a panel, centres at half-integers, v downwards."""
    return (point[1] / width_m + 0.5) * width, (0.5 - point[2] / height_m) * height


def bilinear(layer: list[list[float]], u: float, v: float) -> float:
    """Value of a grey image at a continuous position: linear between pixel centres, constant beyond the last."""
    height, width = len(layer), len(layer[0])
    x, y = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
    c, r = int(x), int(y)
    right, below = min(c + 1, width - 1), min(r + 1, height - 1)
    top = layer[r][c] * (1 - (x - c)) + layer[r][right] * (x - c)
    bottom = layer[below][c] * (1 - (x - c)) + layer[below][right] * (x - c)
    return top * (1 - (y - r)) + bottom * (y - r)


def traced_pixel(
    eye: Vector,
    layers: list[list[list[float]]],
    x_m: tuple[float, ...],
    u: float,
    v: float,
    *,
    width_m: float,
    height_m: float,
    image_size: tuple[int, int],
    fov_deg: float,
) -> tuple[float, bool, float]:
    """Intensity along one ray, whether it counts, and its distance (pixels) from that limit.

    layers: per panel a grey image of panel values in [0, 1]. The Jones product is worked out rotation by rotation.
    """
    direction = ray(eye, u, v, width=image_size[0], height=image_size[1], fov_deg=fov_deg)
    field = (1.0, 0.0)
    counts, margin = direction[0] < 0.0, math.inf
    for layer, x in zip(layers, x_m, strict=True):
        height, width = len(layer), len(layer[0])
        if direction[0] == 0.0:
            return math.nan, False, 0.0
        a, b = panel_pixel(hit_plane(eye, direction, x), width_m=width_m, height_m=height_m, width=width, height=height)
        inside = min(a - 0.5, width - 0.5 - a, b - 0.5, height - 0.5 - b)
        counts, margin = counts and inside > 0.0, min(margin, abs(inside))
        angle = bilinear(layer, a, b) * math.pi / 2
        c, s = math.cos(angle), math.sin(angle)
        field = (c * field[0] - s * field[1], s * field[0] + c * field[1])
    return field[1] ** 2, counts, margin


def carried_errors(
    nominal: Vector, true: Vector, layers: Any, picture: Any, stack: PanelStack, *, fov_deg: float
) -> list[float]:
    """Squared errors of the pixels that count, seen from `true` through the points of the centre panel seen nominally.

    layers: (N, H, W, 3 or 4) codes; picture: (h, w, 3) intensities for the nominal eye.
    """
    height, width = picture.shape[:2]
    centre_x = stack.x_m[stack.count // 2]
    grey = [(layer[..., channel] / 255).tolist() for layer in layers for channel in range(3)]
    size = {"width_m": stack.width_m, "height_m": stack.height_m, "width": stack.width_px, "height": stack.height_px}
    squares = []
    for v, u in product(range(height), range(width)):
        direction = ray(nominal, u + 0.5, v + 0.5, width=width, height=height, fov_deg=fov_deg)
        through = subtract(hit_plane(nominal, direction, centre_x), true)
        places = [panel_pixel(hit_plane(true, through, x), **size) for x in stack.x_m]
        if any(not (0.5 < a < stack.width_px - 0.5 and 0.5 < b < stack.height_px - 0.5) for a, b in places):
            continue
        for channel in range(3):
            phase = sum(bilinear(grey[3 * n + channel], a, b) for n, (a, b) in enumerate(places))
            squares.append((math.sin(phase * math.pi / 2) ** 2 - picture[v, u, channel]) ** 2)
    return squares


def jones_intensity(angles: list[float], analyser: float) -> float:
    """Seed (3), literally: |R(-xi) P R(xi) R(-phi_N) .. R(-phi_1) (1, 0)|^2 with complex 2x2 matrices."""

    def times(a: list[list[complex]], b: list[list[complex]]) -> list[list[complex]]:
        return [[sum(a[i][k] * b[k][j] for k in range(2)) for j in range(2)] for i in range(2)]

    def rotation(angle: float) -> list[list[complex]]:
        return [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]

    panels: list[list[complex]] = [[1, 0], [0, 1]]
    for angle in angles:
        panels = times(rotation(-angle), panels)
    polarizer = times(times(rotation(-analyser), [[1, 0], [0, 0]]), rotation(analyser))
    out = times(polarizer, panels)
    return abs(out[0][0]) ** 2 + abs(out[1][0]) ** 2
