"""Simulate the images seen through the layers by an eye with a pinhole or a finite pupil.

`through_layers` adds up panel values along any rays: those of an eye's picture here, and the solution meter's random
rays (`frame/meter.py`). `optics/light.py` measures light by the same rules with many more rays, in compiled code;
`tests/frame/test_meter.py` compares the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.optics.malus import intensity_from_phase
from runtime.optics.rpu import panel_from_image
from runtime.optics.sampling import bilinear, nearest
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import layer_from_seen, layer_pixels_from_seen
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


@dataclass(frozen=True, slots=True)
class Rays:
    """Rays from an eye that looks at the stack's origin, through the pixel centres of its image."""

    from_stack: F64  # (3, 4) projection from frame `stack` to the image (`image_from_stack`)
    u: F64  # (w,) horizontal positions of the pixel centres
    v: F64  # (h, 1) vertical positions of the pixel centres

    @classmethod
    def of_eye(cls, eye_m: ArrayLike, *, width_px: int, height_px: int, fov_deg: float) -> Rays:
        """Create the rays for an eye at (3,) in frame `stack`. `fov_deg` is the horizontal field of view."""
        return cls(
            image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg),
            np.arange(width_px, dtype=np.float64) + 0.5,
            (np.arange(height_px, dtype=np.float64) + 0.5)[:, None],
        )

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.v), len(self.u)

    def on(self, raster: PlaneRaster, rows: slice = slice(None), *, moved: F64 | None = None) -> tuple[F64, F64]:
        """Return the positions u and v where rays cross a raster, in raster pixels (M_RPU).

        Args:
            moved: (3, 3) homography to apply to the positions afterwards.

        Returns:
            u and v, each (h, w) for h traced rows.
        """
        h = panel_from_image(self.from_stack, raster)
        if moved is not None:
            h = moved @ h
        u, v = self.u, self.v[rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            return (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / weight, (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / weight

    def toward_panels(self) -> Mask:
        """Return an (h, w) mask of the rays that point towards the panels rather than away from them."""
        toward = self.toward()
        result: Mask = toward[0] * self.u + toward[1] * self.v + toward[2] < 0.0
        return result

    def toward(self) -> F64:
        """Return the (3,) vector whose dot product with (u, v, 1) is a ray's x component in frame `stack`.
        The x component is negative for rays towards the panels.
        """
        # A ray's direction is the inverse of the projection's left 3x3 part, times (u, v, 1).
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
    """Compute the image seen by a pinhole eye from the sum of panel values along each ray.

    Implements equations (6) and (7) of the supplement.

    Args:
        layers: (N, H, W, 3 or 4) layers, rear to front, as code values or float in [0, 1]. A fourth channel is ignored.

    Raises:
        ValueError: The eye is not in front of every panel.
    """
    eye = checked_eye(eye_m, stack)
    width, height = width_px or layers.shape[2], height_px or layers.shape[1]
    rays = Rays.of_eye(eye, width_px=width, height_px=height, fov_deg=fov_deg)
    panels = [(stack.panel(index), _moved(stack, index, eye)) for index in range(stack.count)]
    return through_layers(
        layers, lambda rows: (rays.on(panel, rows, moved=m) for panel, m in panels), rays.toward_panels(), stack
    )


def _moved(stack: PanelStack, index: int, eye_m: F64) -> F64 | None:
    """Return the 3x3 homography from ideal-panel pixels to layer pixels as seen from an eye. Returns None if the panels
    are parallel, because the homography is then the identity.
    """
    if stack.tilt is None:
        return None
    return layer_pixels_from_seen(stack.panel(index), layer_from_seen(stack, index, eye_m))


def checked_eye(eye_m: ArrayLike, stack: PanelStack) -> F64:
    """Return a (3,) eye as float64. Raises ValueError unless the eye is in front of every panel."""
    eye = np.asarray(eye_m, dtype=np.float64)
    if not np.isfinite(eye).all() or eye[0] <= max(stack.x_m):
        raise ValueError("the eye must be in front of every panel")
    return eye


def through_layers(
    layers: U8 | F32,
    positions: Callable[[slice], Iterable[tuple[F64, F64]]],
    mask: Mask,
    stack: PanelStack,
    *,
    boxes: bool = False,
) -> Retina:
    """Compute an image by adding up panel values along rays, given their positions on each panel.

    Args:
        layers: (N, H, W, 3 or 4) layers, rear to front, as code values or float in [0, 1]. A fourth channel is ignored.
        positions: Function that maps a slice of image rows to positions u and v on every panel, rear to front, each (h,
            w) in panel pixels.
        mask: (h, w) mask of the rays that may count. The result's mask also excludes rays that miss a panel or cross it
            less than half a pixel inside its edge.
        boxes: True to treat each panel pixel as a uniform square. False to interpolate bilinearly.
    """
    image, counted = np.empty((*mask.shape, 3), np.float32), mask.copy()
    unit, sampled = np.float32(1 / 255 if layers.dtype == np.uint8 else 1), nearest if boxes else bilinear
    for rows in strips(mask.shape[0]):
        total = np.zeros((rows.stop - rows.start, mask.shape[1], layers.shape[-1]), np.float32)
        for layer, (u, v) in zip(layers, positions(rows), strict=True):
            x, y = u.astype(np.float32), v.astype(np.float32)
            total += sampled(layer, x, y)
            counted[rows] &= (x > 0.5) & (x < stack.width_px - 0.5) & (y > 0.5) & (y < stack.height_px - 0.5)
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
