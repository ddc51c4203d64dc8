"""Geometry of the stack of panels, and rasters on planes parallel to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from runtime.records import F64

UNEVEN_MOST = 0.15  # largest minus smallest gap over the mean gap (docs/models.md)


@dataclass(frozen=True, slots=True)
class PlaneRaster:
    """A pixel grid on a plane x = x_m of the `stack` frame, rows along -z, columns along +y.

    Pixel (u, v), continuous with centres at half-integers, is at y = left_m + u·pitch_u_m, z = top_m - v·pitch_v_m.
    """

    x_m: float
    left_m: float  # y of the left edge (u = 0)
    top_m: float  # z of the top edge (v = 0)
    pitch_u_m: float
    pitch_v_m: float
    width_px: int
    height_px: int

    def stack_from_raster(self) -> F64:
        """Return the 3x3 map to homogeneous `stack` coordinates (x, y, z) from a homogeneous pixel (u, v, 1)."""
        return np.array([[0.0, 0.0, self.x_m], [self.pitch_u_m, 0.0, self.left_m], [0.0, -self.pitch_v_m, self.top_m]])

    def plane_from_raster(self) -> F64:
        """Return the 3x3 map to homogeneous (y, z, 1) on the plane from homogeneous (u, v, 1)."""
        return np.array([[self.pitch_u_m, 0.0, self.left_m], [0.0, -self.pitch_v_m, self.top_m], [0.0, 0.0, 1.0]])

    def raster_from_plane(self) -> F64:
        """Return the 3x3 map to homogeneous (u, v, 1) from (y, z, 1) on the plane, in closed form."""
        return np.array(
            [
                [1.0 / self.pitch_u_m, 0.0, -self.left_m / self.pitch_u_m],
                [0.0, -1.0 / self.pitch_v_m, self.top_m / self.pitch_v_m],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True, slots=True)
class Tilt:
    """Slopes of panels that are not quite parallel, and the position from which they were registered."""

    depth: tuple[tuple[float, float, float], ...]  # per panel (d, r, u): at (y, z), x = x_m + d + r·y + u·z
    seen_from_m: tuple[float, float, float]  # frame `stack`


@dataclass(frozen=True, slots=True)
class PanelStack:
    """Geometry of the display: (nearly) parallel panels of one size, rear (0) to front (N-1)."""

    width_m: float
    height_m: float
    x_m: tuple[float, ...]  # ascending; frame `stack`
    width_px: int
    height_px: int
    tilt: Tilt | None = None  # None: the panels are parallel

    @property
    def count(self) -> int:
        return len(self.x_m)

    @property
    def is_evenly_spaced(self) -> bool:
        """True if the gaps are equal enough for the shipped networks (`UNEVEN_MOST`)."""
        gaps = np.diff(self.x_m)
        return bool(gaps.size == 0 or np.ptp(gaps) <= UNEVEN_MOST * gaps.mean())

    def reduced(self, reduction: int) -> PanelStack:
        """Return the stack with its rows and columns divided by `reduction`; at least one of each remains."""
        if reduction == 1:
            return self
        width_px, height_px = (max(1, round(px / reduction)) for px in (self.width_px, self.height_px))
        return replace(self, width_px=width_px, height_px=height_px)

    def transposed(self) -> PanelStack:
        """Return the stack with rows and columns swapped: down (-z) becomes right (+y), and vice versa."""
        tilt = self.tilt
        if tilt is not None:
            x, y, z = tilt.seen_from_m
            tilt = Tilt(tuple((d, -u, -r) for d, r, u in tilt.depth), (x, -z, -y))
        return PanelStack(self.height_m, self.width_m, self.x_m, self.height_px, self.width_px, tilt)

    def panel(self, index: int) -> PlaneRaster:
        """Return the pixel grid of panel `index`."""
        return PlaneRaster(
            x_m=self.x_m[index],
            left_m=-self.width_m / 2,
            top_m=self.height_m / 2,
            pitch_u_m=self.width_m / self.width_px,
            pitch_v_m=self.height_m / self.height_px,
            width_px=self.width_px,
            height_px=self.height_px,
        )
