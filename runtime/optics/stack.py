"""Geometry of the panel stack, and of pixel grids on planes parallel to the panels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from runtime.records import F64

UNEVEN_MOST = 0.15  # maximum (largest gap - smallest gap) / mean gap for the shipped networks (docs/models.md)


@dataclass(frozen=True, slots=True)
class PlaneRaster:
    """Pixel grid on the plane x = x_m in frame `stack`. u points along +y (right) and v along -z (down).

    Pixel coordinates are continuous, with pixel centres at half-integers. The pixel position (u, v) lies at y = left_m
    + u·pitch_u_m and z = top_m - v·pitch_v_m.
    """

    x_m: float
    left_m: float  # y of the left edge (u = 0)
    top_m: float  # z of the top edge (v = 0)
    pitch_u_m: float
    pitch_v_m: float
    width_px: int
    height_px: int

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
        """Return a stack with the same size in metres but fewer pixels.

        The rows and columns are divided by `reduction`, with at least one of each left.
        """
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
