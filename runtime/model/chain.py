"""Raster that splits the difference between the eyes into small linear systems, called chains.

If g is added to the front panel and subtracted from the rear panel, and the parallax is s, the eyes' phases differ by

    D(p) = 2·[g(p + s) - g(p - s)].

If the raster's columns are spaced so that s is a whole number K of columns, then columns 2K apart form chains that do
not interact. On every chain, D = A·g with the same bidiagonal matrix A.

If one eye is nearer to the panels than the other, s varies across the raster. Projected onto a plane parallel to the
panels, an outer panel is scaled about the point F where the line through the eyes meets that plane, and the two eyes'
scales are reciprocal. If the columns are spaced by the logarithm of their distance from F, and the rows run towards F,
the scaling becomes a shift again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import atanh, ceil, inf, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.optics.stack import PanelStack, Plane
from runtime.records import F32, F64, Eyes

CELLS_STEP = 8  # chain lengths are rounded up to a multiple of this, so that a moving viewer causes few shapes
ROWS_STEP = 32  # if the eyes are not level, the number of rows is rounded up to a multiple of this
# Maximum number of rows, relative to level eyes. For a walking viewer, this limit saves a quarter of the network's
# time.
ROWS_SHARE = 1.75
CELLS_MAX = 1024
# Maximum column width, in panel columns / `reduction`. 1.2 would lose up to 0.25 dB, and 0.7 would gain nothing.
WIDEST = 0.8
LEAST_CELL_PX = 2  # one column per parallax would exceed a recorded error limit (eyes near a panel of 64 columns)
BLOCK_ROWS = 8  # rows that the network transforms together; the number of rows is always a multiple of this
ROWS_MAX = 1 << 15  # eye positions are implausible if they would need more rows than this at full height
NEAREST_F = 0.8  # maximum ratio of the raster's half width to the distance from its middle to F
FARTHEST_F = 0.01  # below this ratio, s varies by less than 1 %, and the columns are evenly spaced

Columns = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class ColumnLaw:
    """Columns u as t = middle + (1 - exp(-bend·(u - middle)))/bend, for homographies; t = u without bend."""

    bend: float = 0.0  # per column
    middle: float = 0.0  # column where t = u

    def homography_from_column(self, u: Columns) -> Columns:
        """Return t for an array of columns u."""
        if not self.bend:
            return u
        return np.asarray(self.middle - np.expm1(-self.bend * (u - self.middle)) / self.bend)

    def mirrored(self, width_px: int) -> ColumnLaw:
        """Return the law for a raster with its `width_px` columns in reverse order."""
        return ColumnLaw(-self.bend, width_px - self.middle) if self.bend else self


EVEN_COLUMNS = ColumnLaw()


@dataclass(frozen=True, slots=True)
class ChainFrame:
    """Raster on the plane where the two outer panels have equal and opposite parallaxes. The homographies
    apply to points (t, v, 1), where v is the row, and `columns` converts the column u to t.
    """

    x_m: float  # the plane's x coordinate in frame `stack`
    plane_from_raster: F64  # 3x3 map from (t, v, 1) to points (y, z, 1) on the plane; t runs along the line of the eyes
    columns: ColumnLaw
    cells: int  # chain cells per row; the raster has cells·2K columns
    cell_px: int  # K
    rows: int
    stretch: float  # height covered by the rows, relative to level eyes
    middle_m: F64  # (3,) point between the eyes, frame `stack`; relative to it, the eyes' parallaxes are opposite

    @property
    def width_px(self) -> int:
        return self.cells * 2 * self.cell_px

    def plane_from_frame(self, eye_m: F64, *, x_m: float) -> F64:
        """Return the 3x3 map along a (3,) eye's rays from (t, v, 1) to (y, z, 1) on the plane at `x_m`."""
        return Plane(self.x_m).to(Plane(x_m), eye_m) @ self.plane_from_raster

    def frame_from_plane(self, *, x_m: float) -> F64:
        """Return the 3x3 map from (y, z, 1) on the plane at `x_m` to (t, v, 1), along rays from `middle_m`."""
        inverse = np.linalg.inv(self.plane_from_frame(self.middle_m, x_m=x_m))
        return np.asarray(inverse / inverse[2, 2], np.float64)

    def eye_sigma_px(self, stack: PanelStack, *, eye_sigma_m: float, cell_px: int) -> F32:
        """Return the three lengths (3,) that the network needs, given the tracking error's deviation.

        The first two are how far this error moves the outer panels' pictures, along and across the rows. The third is
        the centre panel's parallax relative to the raster's plane, along the rows. Lengths along the rows are in units
        of the outer panels' parallax divided by `cell_px`, from the model's contract, and lengths across the rows are
        in rows.
        """
        reach = (stack.x_m[-1] - self.x_m) / (self.middle_m[0] - stack.x_m[-1])
        centre = (self.x_m - stack.x_m[1]) / (self.middle_m[0] - stack.x_m[1])
        moved_m = eye_sigma_m * reach
        # Metres to the right and up per column, and metres up per row, at the raster's middle.
        raster = self.plane_from_raster
        at = raster @ (self.columns.middle, self.rows / 2, 1.0)  # whose weight is 1
        (across_m, along_m), (_, down_m) = (raster[:2, k] - at[:2] * raster[2, k] for k in (0, 1))
        columns = moved_m / abs(across_m) * cell_px / self.cell_px
        rows = moved_m * np.hypot(1.0, along_m / across_m) / abs(down_m)
        return np.array([columns, rows, cell_px * centre / reach], np.float32)


def chain_frame(eyes_m: Eyes, stack: PanelStack, *, most_cell_px: int, reduction: int) -> ChainFrame:
    """Return the raster for a pair of eyes, with rows of `reduction` panel rows, sheared along the line
    of the eyes.

    It covers the part of the panels that the eyes see through all of them, plus a margin. The outer panels' parallax is
    the smallest whole number of columns that makes a column at most `WIDEST` wide, but at most `most_cell_px` (K). If
    the eyes are not level, rows may be taller. Raises ValueError if the eyes are not horizontally separated, or the
    raster would be implausibly tall.
    """
    between_m, half_m = eyes_m.mean(axis=0), (eyes_m[1] - eyes_m[0]) / 2
    plane_m = _equal_parallax_m(stack, between_m[0])
    ahead_m = between_m[0] - plane_m
    middle_m = between_m - half_m * (half_m[0] / ahead_m)
    window = _window_of(middle_m, stack, plane_m=plane_m)
    line = _line_of_eyes(between_m, half_m, plane_m=plane_m, window=window)
    per_parallax = (stack.x_m[-1] - plane_m) / (middle_m[0] - stack.x_m[-1]) / ahead_m
    parallax_m = abs(line.from_f_m2[0] * per_parallax)  # at the window's middle
    widest_m = WIDEST * reduction * stack.width_m / stack.width_px
    cell_px = min(max(ceil(parallax_m / widest_m), LEAST_CELL_PX), most_cell_px)
    per_column, column_m = per_parallax / cell_px, parallax_m / cell_px
    if column_m < 1e-12:
        raise ValueError("the eyes have no horizontal separation as seen from the display")
    half_columns = window.half_width_m / column_m * (atanh(line.nearness) / line.nearness if line.nearness else 1.0)
    cells = min(CELLS_MAX, CELLS_STEP * ceil((ceil(half_columns / cell_px) + 1) / CELLS_STEP))
    middle_column = cells * cell_px
    bend, (bend_y_m, bend_z_m) = line.nearer_m * per_column, line.towards_f_m2 * per_column
    columns = ColumnLaw(float(bend), float(middle_column))
    # Extent to cover at each end of the rows, measured at the raster's middle.
    ends = columns.homography_from_column(np.array([0.0, 2.0 * middle_column])) - middle_column
    reached_m = [z * (1 - bend * end) + bend_z_m * end for z in (window.bottom_m, window.top_m) for end in ends]
    height_m, level_rows = max(reached_m) - min(reached_m), stack.height_px / reduction
    share = height_m / window.height_m
    if level_rows * share > ROWS_MAX:
        raise ValueError(
            f"these eye positions are implausible because they would require a raster {share:.0f} times as high as "
            "the panels"
        )
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
    return ChainFrame(plane_m, plane_from_raster, columns, cells, cell_px, rows, share, middle_m)


@dataclass(frozen=True, slots=True)
class _Window:
    """A raster's extent on its plane, in metres in frame `stack`."""

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
        """The window's centre (y, z), as a (2,) array."""
        return np.array([self.low_m + self.high_m, self.bottom_m + self.top_m]) / 2


@dataclass(frozen=True, slots=True)
class _LineOfEyes:
    """The point F at (y, z) = towards_f_m2 / nearer_m, maybe infinitely far, of the eyes' line in the plane."""

    nearer_m: float  # half the difference in x between the eyes, right minus left; 0: F is treated as infinitely far
    towards_f_m2: F64  # (2,) (y, z) of F, times nearer_m
    from_f_m2: F64  # (2,) vector from F to the window's middle, times nearer_m
    nearness: float  # the window's half width / the distance from its middle to F; 0 if F is infinitely far


def _line_of_eyes(between_m: F64, half_m: F64, *, plane_m: float, window: _Window) -> _LineOfEyes:
    """Return the point F for eyes at between_m ± half_m, infinitely far if it is too close to the window or too far."""
    nearer_m, ahead_m = float(half_m[0]), between_m[0] - plane_m
    towards = nearer_m * between_m[1:] - ahead_m * half_m[1:]
    from_f = nearer_m * window.middle_m - towards
    nearness = window.half_width_m * nearer_m / from_f[0] if from_f[0] else inf
    if abs(nearness) > NEAREST_F:
        return _LineOfEyes(0.0, -from_f, from_f, 0.0)
    if abs(nearness) < FARTHEST_F:  # keep rows level for level eyes, because level rows are sampled more accurately
        level = -ahead_m * half_m[1:]
        return _LineOfEyes(0.0, level, -level, 0.0)
    return _LineOfEyes(nearer_m, towards, from_f, float(nearness))


def _equal_parallax_m(stack: PanelStack, eye_x_m: float) -> float:
    """Return x for the plane where the two outer panels have equal and opposite parallaxes. If both gaps are a and the
    eyes are a distance e from the centre panel, the plane is a²/e in front of that panel.
    """
    rear_m, front_m, far_m = stack.x_m[1] - stack.x_m[0], stack.x_m[2] - stack.x_m[1], eye_x_m - stack.x_m[1]
    ahead = 2 * rear_m * front_m + far_m * (front_m - rear_m)
    return float(stack.x_m[1] + ahead / (2 * far_m + (rear_m - front_m)))


def _window_of(middle: F64, stack: PanelStack, *, plane_m: float) -> _Window:
    """Return the part of the raster's plane crossed by rays from `middle` (3,) through all panels. Its height
    corresponds to the centre panel's height. Its width is at least 10 % of the panel width.
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
    """Return V, Ũ (cells + 1, cells + 1), s (cells + 1,), U^T (cells + 1, cells): the chains' modes.

    The (cells, cells + 1) difference operator A, with rows [.. -2 2 ..], is U·diag(s)·V^T. The mean operator B, with
    rows [.. 1/2 1/2 ..], is U·diag(cos)·Ũ^T, where cos = sqrt(1 - s²/16). The modes are known in closed form: they are
    sines and cosines of the same frequencies. A maps the first mode of V to 0.
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


@lru_cache(maxsize=8)
def cell_waves(cell_px: int) -> tuple[F32, F32]:
    """Return an orthonormal real Fourier basis (2K, 2K) of a cell's columns, a wave per row, and its
    (2K,) frequencies. Frequencies are in radians per parallax, that is, per `cell_px` (K) columns.
    """
    size = 2 * cell_px
    at = np.arange(size)
    waves, frequencies = [np.full(size, 1 / np.sqrt(size))], [0.0]
    for k in range(1, cell_px):
        for wave in (np.cos, np.sin):
            waves.append(wave(2 * np.pi * k * at / size) * np.sqrt(2 / size))
            frequencies.append(np.pi * k)
    waves.append(np.cos(np.pi * at) / np.sqrt(size))
    frequencies.append(np.pi * cell_px)
    return np.array(waves, np.float32), np.array(frequencies, np.float32)
