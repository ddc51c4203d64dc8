"""Geometry of the panel stack: planes parallel to the panels, pixel grids, and maps between them.

Pixel positions (u, v) are continuous, with pixel centres at half-integers. OpenCV counts from the first pixel's centre;
`between_pixel_centres` is the only place that converts between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from runtime.records import F64

UNEVEN_MOST = 0.15  # maximum (largest gap - smallest gap) / mean gap for the shipped networks (docs/models.md)


_CORNER_FROM_CENTRE = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
_CENTRE_FROM_CORNER = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])


def between_pixel_centres(target_from_source: F64) -> F64:
    """Convert a 3x3 homography between pixel grids for OpenCV, which has pixel centres at integers."""
    return np.asarray(_CENTRE_FROM_CORNER @ target_from_source @ _CORNER_FROM_CENTRE, np.float64)


@dataclass(frozen=True, slots=True)
class Plane:
    """The plane x = x_m in frame `stack`, with points (y, z) in metres."""

    x_m: float

    def scale_shift_to(self, other: Plane, eye_m: ArrayLike) -> tuple[F64, F64]:
        """Return the scales (...) and shifts (..., 2) in metres by which rays from eyes (..., 3) project this
        plane onto another. The point p is projected to p·scale + shift. Raises ValueError if an eye is in this plane.
        """
        eye = np.asarray(eye_m, np.float64)
        distance_m = eye[..., 0] - self.x_m
        if not np.all(distance_m):
            raise ValueError("an eye in a panel's plane cannot see through the panel")
        shift_m = eye[..., 1:] * ((other.x_m - self.x_m) / distance_m)[..., None]
        return np.asarray((eye[..., 0] - other.x_m) / distance_m), shift_m

    def to(self, other: Plane, eye_m: ArrayLike) -> F64:
        """Return the projection of `scale_shift_to` as (..., 3, 3) matrices for points (y, z, 1)."""
        scale, shift_m = self.scale_shift_to(other, eye_m)
        matrix = np.zeros((*scale.shape, 3, 3))
        matrix[..., 0, 0] = matrix[..., 1, 1] = scale
        matrix[..., :2, 2], matrix[..., 2, 2] = shift_m, 1.0
        return matrix


@dataclass(frozen=True, slots=True)
class PlaneRaster:
    """Pixel grid on x = x_m in `stack`: (u, v) is at y = left_m + u·pitch_u_m, z = top_m - v·pitch_v_m."""

    x_m: float
    left_m: float  # y of the left edge (u = 0)
    top_m: float  # z of the top edge (v = 0)
    pitch_u_m: float
    pitch_v_m: float
    width_px: int
    height_px: int

    @property
    def plane(self) -> Plane:
        return Plane(self.x_m)

    def to(self, other: PlaneRaster, eye_m: ArrayLike) -> F64:
        """Return the (..., 3, 3) maps to another raster's pixels along the rays of eyes (..., 3). Raises
        ValueError if an eye is in this raster's plane.
        """
        return np.asarray(other.raster_from_plane() @ self.plane.to(other.plane, eye_m) @ self.plane_from_raster())

    def to_from(self, other: PlaneRaster, eye_m: Sequence[float]) -> F64:
        """Return the map of `to` for one eye, whose distance from the plane is not checked. At every refresh,
        plain floats are several times as fast as small arrays.
        """
        distance_m = eye_m[0] - self.x_m
        scale, step = (eye_m[0] - other.x_m) / distance_m, (other.x_m - self.x_m) / distance_m
        shift_u = (self.left_m * scale + eye_m[1] * step - other.left_m) / other.pitch_u_m
        shift_v = -(self.top_m * scale + eye_m[2] * step - other.top_m) / other.pitch_v_m
        scale_u, scale_v = scale * self.pitch_u_m / other.pitch_u_m, scale * self.pitch_v_m / other.pitch_v_m
        return np.array([[scale_u, 0.0, shift_u], [0.0, scale_v, shift_v], [0.0, 0.0, 1.0]])

    def to_and_back(self, via: Plane, *, old_m: Sequence[float], step_m: Sequence[float]) -> F64:
        """Return the 3x3 map of pixels onto a plane from the eye at old_m + step_m, and back from the eye at
        old_m. Exactly the identity if the step is zero or the plane is the raster's. `optics.alignment` derives the
        equation.
        """
        distance_m, height_m = old_m[0] - self.x_m, old_m[0] - via.x_m
        now_m = distance_m + step_m[0]
        magnified = step_m[0] * (via.x_m - self.x_m) / (now_m * height_m)
        behind = (self.x_m - via.x_m) / height_m
        right_m, up_m = (behind * (old_m[k] * step_m[0] - step_m[k] * distance_m) / now_m for k in (1, 2))
        # Pixel coordinates start at the raster's top left corner, not at the plane's origin.
        shift_u = (self.left_m * magnified + right_m) / self.pitch_u_m
        shift_v = -(self.top_m * magnified + up_m) / self.pitch_v_m
        scale = 1.0 + magnified
        return np.array(
            [[scale, 0.0, shift_u + 0.0], [0.0, scale, shift_v + 0.0], [0.0, 0.0, 1.0]]
        )  # no negative zeros

    def stack_from_raster(self) -> F64:
        """Return the 3x3 matrix from pixels (u, v, 1) to coordinates (x, y, z) in frame `stack`."""
        return np.array([[0.0, 0.0, self.x_m], [self.pitch_u_m, 0.0, self.left_m], [0.0, -self.pitch_v_m, self.top_m]])

    def plane_from_raster(self) -> F64:
        """Return the 3x3 matrix from pixels (u, v, 1) to points (y, z, 1) on the raster's plane."""
        return np.array([[self.pitch_u_m, 0.0, self.left_m], [0.0, -self.pitch_v_m, self.top_m], [0.0, 0.0, 1.0]])

    def raster_from_plane(self) -> F64:
        """Return the 3x3 matrix from points (y, z, 1) on the raster's plane to pixels (u, v, 1)."""
        return np.array(
            [
                [1.0 / self.pitch_u_m, 0.0, -self.left_m / self.pitch_u_m],
                [0.0, -1.0 / self.pitch_v_m, self.top_m / self.pitch_v_m],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True, slots=True)
class Tilt:
    """Slopes of panels that are not quite parallel, and the position they were registered from."""

    depth: tuple[tuple[float, float, float], ...]  # (d, r, u) for each panel's plane, x = x_m + d + r·y + u·z
    seen_from_m: tuple[float, float, float]  # frame `stack`


@dataclass(frozen=True, slots=True)
class PanelStack:
    """Display geometry: parallel or nearly parallel panels of equal size, from rear to front."""

    width_m: float
    height_m: float
    x_m: tuple[float, ...]  # x coordinate of each panel in frame `stack`, in ascending order
    width_px: int
    height_px: int
    tilt: Tilt | None = None  # None: the panels are parallel
    colour: tuple[bool, ...] = ()  # for each panel, True if it has colour filters; empty: all panels have

    @property
    def count(self) -> int:
        return len(self.x_m)

    def is_grey(self, n: int) -> bool:
        """Return True if panel `n` has no colour filters: its pixels have one value for all channels."""
        return bool(self.colour) and not self.colour[n]

    @property
    def is_evenly_spaced(self) -> bool:
        """True if the gaps between panels are even enough for the shipped networks (`UNEVEN_MOST`)."""
        gaps = np.diff(self.x_m)
        return bool(gaps.size == 0 or np.ptp(gaps) <= UNEVEN_MOST * gaps.mean())

    def reduced(self, reduction: int) -> PanelStack:
        """Return a stack of the same size with 1/`reduction` of the rows and columns, at least one of each."""
        if reduction == 1:
            return self
        width_px, height_px = (max(1, round(px / reduction)) for px in (self.width_px, self.height_px))
        return replace(self, width_px=width_px, height_px=height_px)

    def transposed(self) -> PanelStack:
        """Return the stack with rows and columns swapped: down (-z) becomes right (+y), right becomes down."""
        tilt = self.tilt
        if tilt is not None:
            x, y, z = tilt.seen_from_m
            tilt = Tilt(tuple((d, -u, -r) for d, r, u in tilt.depth), (x, -z, -y))
        return PanelStack(self.height_m, self.width_m, self.x_m, self.height_px, self.width_px, tilt, self.colour)

    def panel(self, index: int) -> PlaneRaster:
        """Return the pixel grid of panel `index`, treating the panel as parallel to the others."""
        return PlaneRaster(
            x_m=self.x_m[index],
            left_m=-self.width_m / 2,
            top_m=self.height_m / 2,
            pitch_u_m=self.width_m / self.width_px,
            pitch_v_m=self.height_m / self.height_px,
            width_px=self.width_px,
            height_px=self.height_px,
        )
