"""A rectangle of whole pixels: what is drawn, solved or shown of a raster."""

from __future__ import annotations

from dataclasses import dataclass, replace

from runtime.optics.stack import PlaneRaster


@dataclass(frozen=True, slots=True)
class PixelRect:
    """Pixels [u0, u1) x [v0, v1) of a raster; u right, v down. Empty where an end is not beyond its beginning."""

    u0: int
    v0: int
    u1: int
    v1: int

    @property
    def width_px(self) -> int:
        return max(self.u1 - self.u0, 0)

    @property
    def height_px(self) -> int:
        return max(self.v1 - self.v0, 0)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, to index an image."""
        return slice(self.v0, self.v1), slice(self.u0, self.u1)

    def cut(self, raster: PlaneRaster) -> PlaneRaster:
        """The part of a raster."""
        return replace(
            raster,
            left_m=raster.left_m + self.u0 * raster.pitch_u_m,
            top_m=raster.top_m - self.v0 * raster.pitch_v_m,
            width_px=self.width_px,
            height_px=self.height_px,
        )
