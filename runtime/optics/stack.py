"""The stack of panels and rasters on planes parallel to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.records import F64


@dataclass(frozen=True, slots=True)
class PlaneRaster:
    """A pixel grid on a plane x = x_m of the `stack` frame, rows along -z, columns along +y.

    Pixel (u, v), continuous with centres at half-integers, lies at y = left_m + u·pitch_u_m,
    z = top_m - v·pitch_v_m.
    """

    x_m: float
    left_m: float  # y of the left edge (u = 0)
    top_m: float  # z of the top edge (v = 0)
    pitch_u_m: float
    pitch_v_m: float
    width_px: int
    height_px: int

    def stack_from_raster(self) -> F64:
        """3x3: homogeneous `stack` coordinates (x, y, z) of a homogeneous pixel (u, v, 1)."""
        return np.array([[0.0, 0.0, self.x_m], [self.pitch_u_m, 0.0, self.left_m], [0.0, -self.pitch_v_m, self.top_m]])

    def plane_from_raster(self) -> F64:
        """3x3: homogeneous (y, z, 1) on the plane from homogeneous (u, v, 1)."""
        return np.array([[self.pitch_u_m, 0.0, self.left_m], [0.0, -self.pitch_v_m, self.top_m], [0.0, 0.0, 1.0]])

    def raster_from_plane(self) -> F64:
        """3x3: homogeneous (u, v, 1) from homogeneous (y, z, 1) on the plane; inverse in closed form."""
        return np.array(
            [
                [1.0 / self.pitch_u_m, 0.0, -self.left_m / self.pitch_u_m],
                [0.0, -1.0 / self.pitch_v_m, self.top_m / self.pitch_v_m],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True, slots=True)
class PanelStack:
    """Geometry of the display: parallel panels of one size, rear (0) to front (N-1)."""

    width_m: float
    height_m: float
    x_m: tuple[float, ...]  # ascending; frame `stack`
    width_px: int
    height_px: int

    @property
    def count(self) -> int:
        return len(self.x_m)

    @property
    def is_evenly_spaced(self) -> bool:
        """True where neighbours are equally far apart, to a part in a thousand."""
        gaps = np.diff(self.x_m)
        return bool(gaps.size == 0 or np.ptp(gaps) <= 1e-3 * gaps.mean())

    def panel(self, index: int) -> PlaneRaster:
        """The pixel grid of panel `index`."""
        return PlaneRaster(
            x_m=self.x_m[index],
            left_m=-self.width_m / 2,
            top_m=self.height_m / 2,
            pitch_u_m=self.width_m / self.width_px,
            pitch_v_m=self.height_m / self.height_px,
            width_px=self.width_px,
            height_px=self.height_px,
        )
