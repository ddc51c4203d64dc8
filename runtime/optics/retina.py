"""Simulated retinas: an eye's images through the layers, for a pinhole or a finite pupil."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.optics.malus import intensity_from_phase
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import layer_from_seen, layer_pixels_from_seen
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8

Mask = NDArray[np.bool_]

STRIP_ROWS = 32  # rows processed together, which fit in the cache


@dataclass(frozen=True, slots=True)
class Retina:
    """An eye's image, and a mask of the rays that cross every panel half a pixel inside its edge."""

    image: F32  # (h, w, 3) in [0, 1]
    mask: Mask  # (h, w)

    def codes(self) -> U8:
        """Return the image as (h, w, 3) 8-bit code values, black where a ray misses a panel."""
        return np.asarray(as_codes(self.image) * self.mask[..., None], np.uint8)


def strips(rows: int) -> Iterator[slice]:
    """Return slices of an image's rows, small enough to stay in the cache between two operations."""
    return (slice(start, min(start + STRIP_ROWS, rows)) for start in range(0, rows, STRIP_ROWS))


def _planes(layer: NDArray[np.uint8] | F32) -> list[F32]:
    return [np.ascontiguousarray(layer[..., channel], np.float32) for channel in range(layer.shape[2])]


class _Samples:
    """Bilinear weights and indices of positions (h, w), computed once for all channels."""

    def __init__(self, u: F32, v: F32, shape: tuple[int, ...]) -> None:
        height, width = shape[:2]
        # fmax and fmin ignore NaN, the position of a ray that never meets the panel.
        x = np.fmin(np.fmax(u - np.float32(0.5), np.float32(0)), np.float32(width - 1))
        y = np.fmin(np.fmax(v - np.float32(0.5), np.float32(0)), np.float32(height - 1))
        self._corner = np.empty((*x.shape, 2), np.int16)
        self._corner[..., 0] = np.fmin(x, np.float32(max(width - 2, 0)))
        self._corner[..., 1] = np.fmin(y, np.float32(max(height - 2, 0)))
        self._x, self._y = x - self._corner[..., 0], y - self._corner[..., 1]
        self._right, self._below = slice(min(1, width - 1), None), slice(min(1, height - 1), None)

    def of(self, plane: F32) -> F32:
        """Return the (h, w) samples of a plane (H, W)."""
        right, below = self._right, self._below
        no_second_map: Any = None  # None is valid, but missing from OpenCV's stubs
        top, top_right, bottom, bottom_right = (
            np.asarray(cv2.remap(part, self._corner, no_second_map, cv2.INTER_NEAREST), np.float32)
            for part in (plane, plane[:, right], plane[below], plane[below, right])
        )
        _mix(top, top_right, self._x)
        _mix(bottom, bottom_right, self._x)
        _mix(top, bottom, self._y)
        return top


def _mix(a: F32, b: F32, weight: F32) -> None:
    """Compute a + (b - a)·weight in `a`; `b` is overwritten."""
    b -= a
    b *= weight
    a += b


@dataclass(frozen=True, slots=True)
class Rays:
    """Rays through the pixels of an image, from an eye that looks at the stack's origin."""

    from_stack: F64  # (3, 4) `image_from_stack`
    u: F64  # (w,) columns
    v: F64  # (h, 1) rows

    @classmethod
    def of_eye(cls, eye_m: ArrayLike, *, width_px: int, height_px: int, fov_deg: float) -> Rays:
        """Create the rays of an eye (3,), in frame `stack`, for an image of this size and field of view."""
        return cls(
            image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg),
            np.arange(width_px, dtype=np.float64) + 0.5,
            (np.arange(height_px, dtype=np.float64) + 0.5)[:, None],
        )

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.v), len(self.u)

    def on(self, raster: PlaneRaster, rows: slice = slice(None), *, moved: F64 | None = None) -> tuple[F64, F64]:
        """Return the raster pixels, u and v (h, w), at which the rays of `rows` cross it (M_RPU).

        moved: (3, 3) map that is applied to those pixels afterwards.
        """
        h = panel_from_image(self.from_stack, raster)
        if moved is not None:
            h = moved @ h
        u, v = self.u, self.v[rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            return (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / weight, (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / weight

    def toward_panels(self) -> Mask:
        """Return an (h, w) mask of the rays that go towards the panels rather than away from them."""
        toward = self.toward()
        result: Mask = toward[0] * self.u + toward[1] * self.v + toward[2] < 0.0
        return result

    def toward(self) -> F64:
        """Return a ray's x component as coefficients (3,) of (u, v, 1); negative towards the panels."""
        # A ray's direction is the inverse of the projection's left part times (u, v, 1).
        return np.asarray(np.linalg.inv(self.from_stack[:, :3])[0])


def seen_by(
    eye_m: ArrayLike,
    layers: U8 | F32,
    stack: PanelStack,
    *,
    fov_deg: float,
    width_px: int | None = None,
    height_px: int | None = None,
) -> Retina:
    """Compute a pinhole eye's image from the panel values summed along each ray (supplement, (6), (7)).

    layers: (N, H, W, 3 or 4), rear to front, uint8 code values or float in [0, 1]; a fourth channel is ignored. By
    default the image has the layers' size. Raises ValueError for an eye behind a panel.
    """
    eye = checked_eye(eye_m, stack)
    width, height = width_px or layers.shape[2], height_px or layers.shape[1]
    rays = Rays.of_eye(eye, width_px=width, height_px=height, fov_deg=fov_deg)
    panels = [(stack.panel(index), _moved(stack, index, eye)) for index in range(stack.count)]
    return through_layers(
        layers, lambda rows: (rays.on(panel, rows, moved=m) for panel, m in panels), rays.toward_panels(), stack
    )


def _moved(stack: PanelStack, index: int, eye_m: F64) -> F64 | None:
    """Return the 3x3 map for an eye from the ideal panel's pixels to a layer's; None: identity."""
    if stack.tilt is None:
        return None
    return layer_pixels_from_seen(stack.panel(index), layer_from_seen(stack, index, eye_m))


def checked_eye(eye_m: ArrayLike, stack: PanelStack) -> F64:
    """Return an eye (3,) as float64. Raises ValueError unless it is in front of every panel."""
    eye = np.asarray(eye_m, dtype=np.float64)
    if not np.isfinite(eye).all() or eye[0] <= max(stack.x_m):
        raise ValueError("the eye must be in front of every panel")
    return eye


def through_layers(
    layers: U8 | F32, positions: Callable[[slice], Iterable[tuple[F64, F64]]], mask: Mask, stack: PanelStack
) -> Retina:
    """Compute an image along rays whose positions on each panel are given.

    positions: function that returns (h, w) u and v on every panel, rear to front, for a slice of rows. mask: (h, w)
    rays that may count; of these, the result's mask keeps those that cross every panel half a pixel inside its edge.
    """
    image, counted = np.empty((*mask.shape, 3), np.float32), mask.copy()
    planes = [_planes(layer[..., :3]) for layer in layers]
    unit = np.float32(1 / 255 if layers.dtype == np.uint8 else 1)
    for rows in strips(mask.shape[0]):
        total = np.zeros((3, rows.stop - rows.start, mask.shape[1]), np.float32)
        for layer, (u, v) in zip(planes, positions(rows), strict=True):
            x, y = u.astype(np.float32), v.astype(np.float32)
            samples = _Samples(x, y, layer[0].shape)
            for channel in range(3):
                total[channel] += samples.of(layer[channel])
            counted[rows] &= (x > 0.5) & (x < stack.width_px - 0.5) & (y > 0.5) & (y < stack.height_px - 0.5)
        image[rows] = np.moveaxis(intensity_from_phase(total * unit), 0, -1)
    return Retina(image, counted)


def as_codes(image: F32) -> U8:
    """Clip intensities (...) to [0, 1] and convert them to 8-bit code values."""
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def pupil_points(diameter_m: float, rings: int = 2) -> F64:
    """Return (K, 2) points (right, up) in metres that cover a round pupil evenly, the centre first."""
    points = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        radius = diameter_m / 2 * ring / (rings + 0.5)
        angles = np.arange(6 * ring) * (2 * np.pi / (6 * ring))
        points += [(radius * np.cos(a), radius * np.sin(a)) for a in angles]
    return np.array(points)


def average(images: Iterable[F32]) -> F32:
    """Return the mean (h, w, C) of images, which a finite pupil sees. Raises ValueError for no images."""
    total: F32 | None = None
    count = 0
    for image in images:
        total = image.copy() if total is None else total + image
        count += 1
    if total is None:
        raise ValueError("a pupil must have at least one point")
    return total / np.float32(count)
