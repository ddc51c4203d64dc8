"""Raster on which the difference between the eyes splits into chains, each a small linear system.

With +g on the front panel and -g on the rear panel, and a parallax of s, the difference between the eyes' phases is

    D(p) = 2·[g(p + s) - g(p - s)].

If the columns of a raster make s a whole number K, columns that are 2K apart form chains that do not interact. Along
each chain D = A·g, with the same bidiagonal A for all.

If one eye is nearer to the panels than the other, s varies. Seen through a plane parallel to the panels, an outer panel
is scaled about the point F where the line through the eyes meets that plane. The scales for the two eyes are
reciprocal. If the columns are spaced by the logarithm of the distance from F, and the rows run towards F, this scaling
becomes a shift again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import atanh, ceil, inf, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.optics.stack import PanelStack
from runtime.records import F32, F64

CELLS_STEP = 8  # chain lengths are rounded up to a multiple of this, so that a moving viewer causes few shapes
ROWS_STEP = 32  # the same for the number of rows, if the eyes are not level
ROWS_SHARE = 1.75  # most rows, relative to level eyes; saves a quarter of the network's time for a walking viewer
CELLS_MAX = 1024
BLOCK_ROWS = 8  # rows that the network transforms together; the raster has whole blocks
ROWS_MAX = 1 << 15  # rows that eyes would need at full height; beyond, they are implausible
NEAREST_F = 0.8  # largest ratio of the raster's half width to its middle's distance from F, which keeps it clear of F
FARTHEST_F = 0.01  # below this ratio s varies by less than a hundredth, so the columns are evenly spaced

Columns = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class ColumnLaw:
    """Spacing of a raster's columns: t = middle + (1 - exp(-bend·(u - middle)))/bend.

    u is the column, and t is the coordinate to which the homography applies. With a bend of 0, columns are even.
    """

    bend: float = 0.0  # per column
    middle: float = 0.0  # column where t = u

    def homography_from_column(self, u: Columns) -> Columns:
        """Return t for an array of columns u."""
        if not self.bend:
            return u
        return np.asarray(self.middle - np.expm1(-self.bend * (u - self.middle)) / self.bend)

    def column_from_homography(self, t: Columns) -> Columns:
        """Return u for an array of coordinates t; beyond F, a value far outside the raster."""
        if not self.bend:
            return t
        return np.asarray(self.middle - np.log(np.maximum(1 - self.bend * (t - self.middle), BEYOND_F)) / self.bend)


EVEN_COLUMNS = ColumnLaw()
BEYOND_F = 1e-9


@dataclass(frozen=True, slots=True)
class ChainFrame:
    """Raster on the plane of equal parallax of both outer panels, seen from between the eyes."""

    x_m: float  # x of that plane: a²/ex
    plane_from_raster: F64  # 3x3, (y, z, 1) from (t, v, 1); t runs along the eyes' line, and `columns` maps u to t
    columns: ColumnLaw
    cells: int  # chain cells per row; the raster has cells·2K columns
    cell_px: int  # K
    rows: int
    middle_m: F64  # (3,) point between the eyes, frame `stack`, relative to which their parallaxes are opposite

    @property
    def width_px(self) -> int:
        return self.cells * 2 * self.cell_px

    def plane_from_frame(self, eye_m: F64, *, x_m: float) -> F64:
        """Return the 3x3 map, along an eye's rays, from (t, v, 1) to (y, z, 1) on the plane at `x_m`."""
        t = (x_m - self.x_m) / (eye_m[0] - self.x_m)
        across = np.array([[1 - t, 0.0, eye_m[1] * t], [0.0, 1 - t, eye_m[2] * t], [0.0, 0.0, 1.0]])
        return across @ self.plane_from_raster

    def frame_from_plane(self, *, x_m: float) -> F64:
        """Return the 3x3 map, along rays from `middle_m`, to (t, v, 1) from (y, z, 1) on the plane at `x_m`."""
        inverse = np.linalg.inv(self.plane_from_frame(self.middle_m, x_m=x_m))
        return np.asarray(inverse / inverse[2, 2], np.float64)

    def eye_sigma_px(self, stack: PanelStack, *, eye_sigma_m: float) -> F32:
        """Return (3,) lengths in pixels of this raster for the network.

        The first two say how far one sigma of the eyes moves the outer panels' pictures, in columns and rows. The
        third is the centre panel's own parallax relative to the raster's plane, in columns.
        """
        reach = (stack.x_m[-1] - self.x_m) / (self.middle_m[0] - stack.x_m[-1])
        centre = (self.x_m - stack.x_m[1]) / (self.middle_m[0] - stack.x_m[1])
        moved_m = eye_sigma_m * reach
        # Metres to the right and up per column, and up per row, at the raster's middle.
        raster = self.plane_from_raster
        at = raster @ (self.columns.middle, self.rows / 2, 1.0)
        (across_m, along_m), (_, down_m) = ((raster[:2, k] - at[:2] / at[2] * raster[2, k]) / at[2] for k in (0, 1))
        columns = moved_m / abs(across_m)
        rows = moved_m * np.hypot(1.0, along_m / across_m) / abs(down_m)
        return np.array([columns, rows, self.cell_px * centre / reach], np.float32)


def chain_frame(eyes_m: F64, stack: PanelStack, *, cell_px: int, reduction: int) -> ChainFrame:
    """Return the raster for a left and a right eye (2, 3) in frame `stack`.

    The columns are scaled so that the outer panels' parallax is `cell_px` columns. Each row is as high as `reduction`
    panel rows and sheared along the line of the eyes. The raster covers the part of all panels that both eyes see,
    plus a margin. Raises ValueError if the eyes have no horizontal separation, or if the raster would be too tall.
    """
    between_m, half_m = eyes_m.mean(axis=0), (eyes_m[1] - eyes_m[0]) / 2
    plane_m = _equal_parallax_m(stack, between_m[0])
    ahead_m = between_m[0] - plane_m
    middle_m = between_m - half_m * (half_m[0] / ahead_m)
    window = _window_of(middle_m, stack, plane_m=plane_m)
    line = _line_of_eyes(between_m, half_m, plane_m=plane_m, window=window)
    per_column = (stack.x_m[-1] - plane_m) / (middle_m[0] - stack.x_m[-1]) / (cell_px * ahead_m)
    column_m = abs(line.from_f_m2[0] * per_column)  # at the window's middle
    if column_m < 1e-12:
        raise ValueError("the eyes have no horizontal separation as seen from the display")
    half_columns = window.half_width_m / column_m * (atanh(line.nearness) / line.nearness if line.nearness else 1.0)
    cells = min(CELLS_MAX, CELLS_STEP * ceil((ceil(half_columns / cell_px) + 1) / CELLS_STEP))
    middle_column = cells * cell_px
    bend, (bend_y_m, bend_z_m) = line.nearer_m * per_column, line.towards_f_m2 * per_column
    columns = ColumnLaw(float(bend), float(middle_column))
    # Extent to cover at either end of the rows, measured at the raster's middle.
    ends = columns.homography_from_column(np.array([0.0, 2.0 * middle_column])) - middle_column
    reached_m = [z * (1 - bend * end) + bend_z_m * end for z in (window.bottom_m, window.top_m) for end in ends]
    height_m, level_rows = max(reached_m) - min(reached_m), stack.height_px / reduction
    share = height_m / window.height_m
    if level_rows * share > ROWS_MAX:
        raise ValueError(f"implausible eye positions would need a raster {share:.0f} times as high as the panels")
    row_m = max(window.height_m, height_m / ROWS_SHARE) / level_rows
    if height_m - window.height_m > 0.01 * row_m:
        rows = ROWS_STEP * ceil(height_m / row_m / ROWS_STEP)
    else:
        rows = BLOCK_ROWS * ceil(level_rows / BLOCK_ROWS)
    middle_y_m = window.middle_m[0] - window.half_width_m * line.nearness / (1 + sqrt(1 - line.nearness**2))
    middle_z_m = (min(reached_m) + max(reached_m)) / 2
    plane_from_raster = np.array([
        [-bend_y_m, 0.0, middle_y_m + bend_y_m * middle_column],
        [-bend_z_m, -row_m, middle_z_m + row_m * rows / 2 + bend_z_m * middle_column],
        [-bend, 0.0, 1.0 + bend * middle_column],
    ])  # fmt: skip
    return ChainFrame(plane_m, plane_from_raster, columns, cells, cell_px, rows, middle_m)


@dataclass(frozen=True, slots=True)
class _Window:
    """Extent of a raster on its plane, in metres; frame `stack`."""

    low_m: float  # along y
    high_m: float
    bottom_m: float  # along z
    top_m: float

    @property
    def half_width_m(self) -> float:
        return (self.high_m - self.low_m) / 2

    @property
    def height_m(self) -> float:
        return self.top_m - self.bottom_m

    @property
    def middle_m(self) -> F64:
        """Centre (2,) of the window: y, z."""
        return np.array([self.low_m + self.high_m, self.bottom_m + self.top_m]) / 2


@dataclass(frozen=True, slots=True)
class _LineOfEyes:
    """Point F = towards_f_m2 / nearer_m, possibly infinite, in which the eyes' line meets the plane."""

    nearer_m: float  # half of the right eye's distance from the plane minus the left eye's; 0: F counts as infinite
    towards_f_m2: F64  # (2,) y, z of F, times nearer_m
    from_f_m2: F64  # (2,) vector from F to the window's middle, times nearer_m
    nearness: float  # the window's half width over its middle's distance from F; 0: F counts as infinite


def _line_of_eyes(between_m: F64, half_m: F64, *, plane_m: float, window: _Window) -> _LineOfEyes:
    """Return the line of eyes at between_m ± half_m (3,). F counts as infinite if too near or too far."""
    nearer_m, ahead_m = float(half_m[0]), between_m[0] - plane_m
    towards = nearer_m * between_m[1:] - ahead_m * half_m[1:]
    from_f = nearer_m * window.middle_m - towards
    nearness = window.half_width_m * nearer_m / from_f[0] if from_f[0] else inf
    if abs(nearness) > NEAREST_F:
        return _LineOfEyes(0.0, -from_f, from_f, 0.0)
    if abs(nearness) < FARTHEST_F:  # level eyes keep level rows, which can be sampled more accurately
        level = -ahead_m * half_m[1:]
        return _LineOfEyes(0.0, level, -level, 0.0)
    return _LineOfEyes(nearer_m, towards, from_f, float(nearness))


def _equal_parallax_m(stack: PanelStack, eye_x_m: float) -> float:
    """Return x of the plane where both outer panels have the same parallax (a²/ex behind the centre)."""
    rear_m, front_m, far_m = stack.x_m[1] - stack.x_m[0], stack.x_m[2] - stack.x_m[1], eye_x_m - stack.x_m[1]
    ahead = 2 * rear_m * front_m + far_m * (front_m - rear_m)
    return float(stack.x_m[1] + ahead / (2 * far_m + (rear_m - front_m)))


def _window_of(middle: F64, stack: PanelStack, *, plane_m: float) -> _Window:
    """Return the part of the plane that rays from `middle` through all panels cross.

    It is as high as the centre panel and at least 10 % as wide as the panels.
    """

    def extent(x_m: float, size_m: float, axis: int) -> tuple[float, float]:
        t = (x_m - plane_m) / (middle[0] - plane_m)
        return (-size_m / 2 - middle[axis] * t) / (1 - t), (size_m / 2 - middle[axis] * t) / (1 - t)

    lows, highs = zip(*(extent(x_m, stack.width_m, 1) for x_m in stack.x_m), strict=True)
    low, high = max(lows), min(highs)
    if high - low < stack.width_m / 10:
        centre = (low + high) / 2
        low, high = centre - stack.width_m / 20, centre + stack.width_m / 20
    return _Window(low, high, *extent(stack.x_m[1], stack.height_m, 2))


@lru_cache(maxsize=8)
def chain_modes(cells: int) -> tuple[F32, F32, F32, F32]:
    """Return the modes of the chain operators for `cells` equations, in closed form.

    The difference operator A (cells, cells + 1), with rows [.. -2 2 ..], is U·diag(s)·V^T. The mean operator B,
    with rows [.. 1/2 1/2 ..], is U·diag(cos)·Ũ^T with cos = sqrt(1 - s²/16). The modes are sines and cosines of the
    same frequencies. Returns V and Ũ (cells + 1, cells + 1), s (cells + 1,) and U^T (cells + 1, cells) as float32;
    A maps the first mode of V to 0.
    """
    angle = np.pi * np.arange(cells + 1) / (cells + 1)
    size = np.sqrt(2 / (cells + 1))
    between = np.outer(np.arange(cells + 1) + 0.5, angle)
    v, shifted = -size * np.cos(between), size * np.sin(between)
    v[:, 0] /= np.sqrt(2)
    u_transposed = size * np.sin(np.outer(angle, np.arange(1, cells + 1)))
    v, shifted, s, u_transposed = (
        np.ascontiguousarray(x, np.float32) for x in (v, shifted, 4 * np.sin(angle / 2), u_transposed)
    )
    return v, shifted, s, u_transposed
