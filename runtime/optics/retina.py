"""Simulated retinas: what an eye sees through the layers (design 5.5), pinhole and with a pupil of finite size."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.optics.malus import intensity_from_phase
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.records import F32, F64, U8

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Retina:
    """An eye's image: intensities and which of its rays cross every panel half a pixel inside its edge."""

    image: F32  # (h, w, 3) in [0, 1]
    mask: Mask  # (h, w)


def sample_bilinear(layer: NDArray[np.uint8] | F32, *, u: F32, v: F32) -> F32:
    """Exact bilinear samples of (H, W, C) at continuous pixel positions (h, w), edges clamped; float32 (h, w, C)."""
    height, width = layer.shape[:2]
    # fmax and fmin, since a ray that never meets the panel has no position: NaN would make an index out of range.
    x = np.fmin(np.fmax(u - np.float32(0.5), np.float32(0)), np.float32(width - 1))
    y = np.fmin(np.fmax(v - np.float32(0.5), np.float32(0)), np.float32(height - 1))
    column = np.minimum(x.astype(np.int32), max(width - 2, 0))
    row = np.minimum(y.astype(np.int32), max(height - 2, 0))
    right, below = min(1, width - 1), min(1, height - 1) * width
    flat = layer.reshape(-1, layer.shape[2])
    index = row * width + column
    fx, fy = (x - column)[..., None], (y - row)[..., None]
    top = flat[index] * (1 - fx) + flat[index + right] * fx
    result: F32 = top * (1 - fy) + (flat[index + below] * (1 - fx) + flat[index + below + right] * fx) * fy
    return result


def panel_positions(
    eye_m: ArrayLike, stack: PanelStack, *, index: int, width_px: int, height_px: int, fov_deg: float
) -> tuple[F32, F32]:
    """Where the rays of an eye's image cross panel `index`: (h, w) u and v in that panel's pixels (M_RPU)."""
    projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    h = panel_from_image(projection, stack.panel(index))
    u, v = np.arange(width_px) + 0.5, (np.arange(height_px) + 0.5)[:, None]
    weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            ((h[0, 0] * u + h[0, 1] * v + h[0, 2]) / weight).astype(np.float32),
            ((h[1, 0] * u + h[1, 1] * v + h[1, 2]) / weight).astype(np.float32),
        )


def ray_mask(eye_m: ArrayLike, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float) -> Mask:
    """(h, w) True where the ray goes towards the panels (not away behind the eye)."""
    pose = stack_from_eye(eye_m)
    camera = np.linalg.inv(
        image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)[:, :3]
        @ pose[:3, :3]
        @ np.diag([1.0, -1.0, -1.0])
    )
    rotation = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    toward = (rotation @ camera)[0]
    u, v = np.arange(width_px) + 0.5, (np.arange(height_px) + 0.5)[:, None]
    result: Mask = toward[0] * u + toward[1] * v + toward[2] < 0.0
    return result


def seen_by(
    eye_m: ArrayLike,
    layers: U8 | F32,
    stack: PanelStack,
    *,
    fov_deg: float,
    width_px: int | None = None,
    height_px: int | None = None,
) -> Retina:
    """What a pinhole eye sees (seed 6, 7): panel values summed along each ray, then sin².

    layers: (N, H, W, 3 or 4), rear to front, uint8 code values or float in [0, 1]; a fourth channel is ignored.
    The image has the layers' size unless told. Raises ValueError for an eye that is not before every panel.
    """
    eye = np.asarray(eye_m, dtype=np.float64)
    if not np.isfinite(eye).all() or eye[0] <= max(stack.x_m):
        raise ValueError("the eye must be in front of every panel")
    width, height = width_px or layers.shape[2], height_px or layers.shape[1]
    view = {"width_px": width, "height_px": height, "fov_deg": fov_deg}
    total = np.zeros((height, width, 3), np.float32)
    mask = ray_mask(eye, stack, **view)  # type: ignore[arg-type]
    for index in range(stack.count):
        u, v = panel_positions(eye, stack, index=index, **view)  # type: ignore[arg-type]
        total += sample_bilinear(layers[index][..., :3], u=u, v=v)
        mask &= (u > 0.5) & (u < stack.width_px - 0.5) & (v > 0.5) & (v < stack.height_px - 0.5)
    if layers.dtype == np.uint8:
        total *= np.float32(1 / 255)
    return Retina(intensity_from_phase(total), mask)


def pupil_points(diameter_m: float, rings: int = 2) -> F64:
    """(K, 2) sample points (right, up) in metres that cover a round pupil evenly; the centre first."""
    points = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        radius = diameter_m / 2 * ring / (rings + 0.5)
        angles = np.arange(6 * ring) * (2 * np.pi / (6 * ring))
        points += [(radius * np.cos(a), radius * np.sin(a)) for a in angles]
    return np.array(points)


def average(images: Iterable[F32]) -> F32:
    """Mean of equally sized images: a finite pupil sees the average of what its points see (seed 1.4)."""
    total: F32 | None = None
    count = 0
    for image in images:
        total = image.copy() if total is None else total + image
        count += 1
    if total is None:
        raise ValueError("a pupil without points sees nothing")
    return total / np.float32(count)
