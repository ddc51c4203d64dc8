"""Rectangles of whole pixels, such as the part of a raster that is drawn, solved or shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from runtime.optics.stack import PlaneRaster


@dataclass(frozen=True, slots=True)
class PixelRect:
    """Raster pixels with u0 <= u < u1 (right) and v0 <= v < v1 (down); empty if u1 <= u0 or v1 <= v0."""

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
    def corners(self) -> tuple[int, int, int, int]:
        return self.u0, self.v0, self.u1, self.v1

    @property
    def slices(self) -> tuple[slice, slice]:
        """Row and column slices that select this rectangle in an image."""
        return slice(self.v0, self.v1), slice(self.u0, self.u1)

    def beside(self, *, width_px: int, height_px: int) -> list[PixelRect]:
        """Return up to four disjoint rectangles that cover the rest of a raster of the given size."""
        if not self.width_px or not self.height_px:
            return [PixelRect(0, 0, width_px, height_px)]
        boxes = (
            PixelRect(0, 0, width_px, self.v0),
            PixelRect(0, self.v1, width_px, height_px),
            PixelRect(0, self.v0, self.u0, self.v1),
            PixelRect(self.u1, self.v0, width_px, self.v1),
        )
        return [box for box in boxes if box.width_px and box.height_px]

    def in_rows(self, rows: int) -> list[PixelRect]:
        """Split the rectangle into rectangles of at most `rows` rows each."""
        return [PixelRect(self.u0, v, self.u1, min(v + rows, self.v1)) for v in range(self.v0, self.v1, rows)]

    def cut(self, raster: PlaneRaster) -> PlaneRaster:
        """Return the part of a raster selected by this rectangle."""
        return replace(
            raster,
            left_m=raster.left_m + self.u0 * raster.pitch_u_m,
            top_m=raster.top_m - self.v0 * raster.pitch_v_m,
            width_px=self.width_px,
            height_px=self.height_px,
        )


def union(boxes: Sequence[PixelRect]) -> PixelRect:
    """Return the smallest rectangle that contains every non-empty rectangle, or an empty one."""
    filled = [box for box in boxes if box.width_px and box.height_px]
    if not filled:
        return PixelRect(0, 0, 0, 0)
    return PixelRect(
        min(box.u0 for box in filled),
        min(box.v0 for box in filled),
        max(box.u1 for box in filled),
        max(box.v1 for box in filled),
    )
