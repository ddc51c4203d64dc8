"""Simulate the images seen through the layers by an eye with a pinhole or a finite pupil.

`through_layers` adds up panel values along any rays: those of an eye's picture here, of a focusing eye's
(`optics/focus.py`), and the solution meter's random rays (`frame/meter.py`). `optics/light.py` measures light by the
same rules with many more rays, in compiled code; `tests/frame/test_meter.py` compares the two.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.optics.malus import intensity_from_phase
from runtime.optics.rpu import panel_from_image
from runtime.optics.sampling import Pixels, bilinear, nearest, projected
from runtime.optics.stack import PanelStack
from runtime.optics.tilt import seen_on_layers
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8

Mask = NDArray[np.bool_]

STRIP_ROWS = 32  # rows processed together, few enough to fit in the cache


@dataclass(frozen=True, slots=True)
class Retina:
    """Image seen by an eye, and a mask of the pixels that count when quality is measured."""

    image: F32  # (h, w, 3) in [0, 1]
    mask: Mask  # (h, w) True for rays that cross every panel at least half a pixel inside the panel's edge

    def codes(self) -> U8:
        """Return the image as (h, w, 3) 8-bit code values. Pixels whose rays miss a panel are black."""
        return np.asarray(as_codes(self.image) * self.mask[..., None], np.uint8)


def strips(rows: int) -> Iterator[slice]:
    """Return slices of an image's rows, each small enough to stay in the cache between operations."""
    return (slice(start, min(start + STRIP_ROWS, rows)) for start in range(0, rows, STRIP_ROWS))


class ImageRays(NamedTuple):
    """Rays from an eye that looks at the stack's origin, through the pixel centres of its image."""

    image_from_stack: F64  # (3, 4)
    u: Pixels  # (w,) columns of the pixel centres
    v: Pixels  # (h, 1) rows of the pixel centres

    @classmethod
    def of_eye(cls, eye_m: ArrayLike, *, width_px: int, height_px: int, fov_deg: float) -> ImageRays:
        """Create the rays for an eye at (3,) in frame `stack`. `fov_deg` is the horizontal field of view."""
        image = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
        return cls(image, np.arange(width_px) + 0.5, np.arange(height_px)[:, None] + 0.5)

    @property
    def toward(self) -> F64:
        """The (3,) vector whose dot product with (u, v, 1) is a ray's x component in frame `stack`.
        It is negative for rays towards the panels.
        """
        # A ray's direction is the inverse of the projection's left 3x3 part, times (u, v, 1).
        return np.asarray(np.linalg.inv(self.image_from_stack[:, :3])[0])

    def toward_panels(self) -> Mask:
        """Return an (h, w) mask of the rays that point towards the panels rather than away from them."""
        toward = self.toward
        result: Mask = toward[0] * self.u + toward[1] * self.v + toward[2] < 0.0
        return result


def layers_from_image(image_from_stack: F64, stack: PanelStack, eye_m: F64) -> F64:
    """Return (N, 3, 3) homographies from an image's pixels to the layers' pixels that its eye sees."""
    panels = [panel_from_image(image_from_stack, stack.panel(index)) for index in range(stack.count)]
    return seen_on_layers(np.stack(panels), stack, eye_m)


def seen_by(
    eye_m: ArrayLike,
    layers: U8 | F32,
    stack: PanelStack,
    *,
    fov_deg: float,
    width_px: int | None = None,
    height_px: int | None = None,
) -> Retina:
    """Compute the image, by default of the layers' size, that a pinhole eye sees through the layers.
    Implements (6) and (7) of the supplement. Raises ValueError if the eye is not in front of every panel.
    """
    eye = checked_eye(eye_m, stack)
    width, height = width_px or layers.shape[2], height_px or layers.shape[1]
    rays = ImageRays.of_eye(eye, width_px=width, height_px=height, fov_deg=fov_deg)
    matrices = layers_from_image(rays.image_from_stack, stack, eye)
    return through_layers(layers, matrices, rays.u, rays.v, rays.toward_panels())


def sees_panels(eye_m: ArrayLike, stack: PanelStack, *, fov_deg: float) -> bool:
    """Return True if a ray of an eye's picture crosses all panels. Raises ValueError as `seen_by` does."""
    coarse = replace(stack, width_px=64, height_px=64)
    return bool(seen_by(eye_m, np.zeros((stack.count, 64, 64, 3), np.uint8), coarse, fov_deg=fov_deg).mask.any())


def checked_eye(eye_m: ArrayLike, stack: PanelStack) -> F64:
    """Return a (3,) eye as float64. Raises ValueError unless the eye is in front of every panel."""
    eye = np.asarray(eye_m, dtype=np.float64)
    if not np.isfinite(eye).all() or eye[0] <= max(stack.x_m):
        raise ValueError("the eye must be in front of every panel")
    return eye


def through_layers(
    layers: U8 | F32, layers_from_rays: F64, u: Pixels, v: Pixels, mask: Mask, *, boxes: bool = False
) -> Retina:
    """Compute an image by adding up panel values along rays. `layers` are codes, or floats in [0, 1].

    The (N, 3, 3) homographies map positions u (w,) or (1, w) and v (h, 1) or (h, w) of rays to the layers' pixels. The
    result's mask is `mask` (h, w) without rays that miss a panel or cross it less than half a pixel inside its edge.
    Panel pixels are uniform squares if `boxes`, or else interpolated bilinearly.
    """
    image, counted, (height_px, width_px) = np.empty((*mask.shape, 3), np.float32), mask.copy(), layers.shape[1:3]
    unit, sampled = np.float32(1 / 255 if layers.dtype == np.uint8 else 1), nearest if boxes else bilinear
    for rows in strips(mask.shape[0]):
        total = np.zeros((rows.stop - rows.start, mask.shape[1], layers.shape[-1]), np.float32)
        for layer, matrix in zip(layers, layers_from_rays, strict=True):
            x, y = (at.astype(np.float32) for at in projected(matrix, u, v[rows])[:2])
            total += sampled(layer, x, y)
            counted[rows] &= (x > 0.5) & (x < width_px - 0.5) & (y > 0.5) & (y < height_px - 0.5)
        image[rows] = intensity_from_phase(total[..., :3] * unit)
    return Retina(image, counted)


def as_codes(image: F32) -> U8:
    """Clip intensities of any shape to [0, 1] and convert them to 8-bit code values."""
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def pupil_points(diameter_m: float, rings: int = 2) -> F64:
    """Return (K, 2) points that cover a round pupil evenly. Each point is an offset (right, up) from the
    pupil's centre in metres. The first point is the centre.
    """
    points = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        radius = diameter_m / 2 * ring / (rings + 0.5)
        angles = np.arange(6 * ring) * (2 * np.pi / (6 * ring))
        points += [(radius * np.cos(a), radius * np.sin(a)) for a in angles]
    return np.array(points)


def average(images: Iterable[F32]) -> F32:
    """Return the (h, w, C) mean of the images seen from the points on a finite pupil. Raises ValueError
    if there are no images.
    """
    total: F32 | None = None
    count = 0
    for image in images:
        total = image.copy() if total is None else total + image
        count += 1
    if total is None:
        raise ValueError("a pupil must have at least one point")
    return total / np.float32(count)
