"""How a part of larger panels ends: what drives the outer panels fades out towards edges that aren't the panels' own.

The wave along the line of the eyes reaches far beyond the difference that it makes. Cut off, it leaves its whole
height as an error in the last parallax. Faded out over n parallaxes it leaves an nth of that in each: an nth of
the energy altogether.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.model.chain import EVEN_COLUMNS, ColumnLaw
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64

QUARTERS = 4  # the finest steps in which 16 bits hold any phase that an eye can lack
CORRECTED_SHARE = 1 / 6  # of the fade, in which corrections fade too: they mend the error of the wave's own


@dataclass(frozen=True, slots=True)
class Fade:
    """In pixels of the part's centre panel."""

    kept: PixelRect  # beside which the outer panels stay even
    over_px: tuple[float, float]  # right and down: how far the fade reaches inwards
    left: bool = True  # the sides that fade: where the part ends within the panels
    top: bool = True
    right: bool = True
    bottom: bool = True

    def transposed(self) -> Fade:
        """The same with rows for columns."""
        box = PixelRect(self.kept.v0, self.kept.u0, self.kept.v1, self.kept.u1)
        return Fade(box, self.over_px[::-1], left=self.top, top=self.left, right=self.bottom, bottom=self.right)

    def wave_weights(self, centre_from_raster: F64, *, rows: int, columns: int, law: ColumnLaw = EVEN_COLUMNS) -> F32:
        """(rows or 1, columns, 1): 0 beside what is kept to 1 inside, on a raster with columns by a law; 3x3."""
        m = centre_from_raster
        t, v = law.homography_from_column(np.arange(columns) + 0.5), (np.arange(rows) + 0.5)[:, None]
        down: F64 = np.asarray(m[1, 1] * v + m[1, 2])
        across: F64 = np.asarray(m[0, 0] * t + m[0, 2])
        if m[0, 1] or m[1, 0] or m[2, 0]:
            w = m[2, 0] * t + m[2, 2]
            across, down = (across + m[0, 1] * v) / w, (down + m[1, 0] * t) / w
        right, below = np.ones((1, columns), np.float32), np.ones((1, 1), np.float32)
        for inside, over_px in self._across(across, self.over_px[0]):
            right = right * np.clip(inside / over_px, 0.0, 1.0).astype(np.float32)
        for inside, over_px in self._down(down, self.over_px[1]):
            below = below * np.clip(inside / over_px, 0.0, 1.0).astype(np.float32)
        return np.asarray(right * below)[..., None]

    def ray_weights(self, centre_from_raster: F64, *, rows: int, columns: int) -> tuple[F32, F32]:
        """(columns,) and (rows,) from 0 to 1: what residuals of rays through a raster of the centre panel are
        multiplied with. None must drive the panels beyond their edges."""
        m = centre_from_raster
        u = m[0, 0] * (np.arange(columns) + 0.5) + m[0, 2]
        v = m[1, 1] * (np.arange(rows) + 0.5) + m[1, 2]
        along, down = (over_px * CORRECTED_SHARE for over_px in self.over_px)
        return _least(self._across(u, along), columns), _least(self._down(v, down), rows)

    def _across(self, u: F64, over_px: float) -> list[tuple[F64, float]]:
        """How far inside the left and right edge columns are, and over how much the edge fades."""
        sides = ((self.left, u - self.kept.u0), (self.right, self.kept.u1 - u))
        return [(inside, over_px) for fades, inside in sides if fades and over_px > 0]

    def _down(self, v: F64, over_px: float) -> list[tuple[F64, float]]:
        """The same of rows."""
        sides = ((self.top, v - self.kept.v0), (self.bottom, self.kept.v1 - v))
        return [(inside, over_px) for fades, inside in sides if fades and over_px > 0]


def _least(edges: Sequence[tuple[F64, float]], count: int) -> F32:
    """(count,): what the nearest of some edges leaves, in whole `QUARTERS`."""
    weights = np.ones(count)
    for inside, over_px in edges:
        weights = np.minimum(weights, np.clip(np.rint(inside / over_px * QUARTERS), 0, QUARTERS) / QUARTERS)
    return weights.astype(np.float32)
