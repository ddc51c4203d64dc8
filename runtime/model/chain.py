"""The common raster in which the eyes' difference splits into chains (one small linear system each).

With +g on the front and -g on the rear panel, the difference between the eyes' phases is
D(p) = 2·[g(p + s) - g(p - s)]. On a raster whose columns make s a whole number K, columns 2K apart form chains
that don't interact: D = A·g along each, with one bidiagonal A for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import F32, F64

CELLS_STEP = 8  # chains' lengths are rounded up to this, so that a moving viewer meets few shapes
ROWS_STEP = 64
CELLS_MAX = 1024
BLOCK_ROWS = 8  # that the network transforms together: the raster has whole blocks


@dataclass(frozen=True, slots=True)
class ChainFrame:
    """The raster on the plane where both outer panels have the same parallax, seen from between the eyes."""

    x_m: float  # of the plane: a²/ex
    plane_from_raster: F64  # 3x3, (y, z, 1) from (u, v, 1); u along the line of the eyes
    cells: int  # chain cells a row; the raster has cells·2K columns
    cell_px: int  # K
    rows: int
    middle_m: F64  # (3,) between the eyes, frame `stack`

    @property
    def width_px(self) -> int:
        return self.cells * 2 * self.cell_px

    def plane_from_frame(self, eye_m: F64, *, x_m: float) -> F64:
        """3x3: (y, z, 1) on a parallel plane hit by an eye's rays through this raster's pixels."""
        t = (x_m - self.x_m) / (eye_m[0] - self.x_m)
        across = np.array([[1 - t, 0.0, eye_m[1] * t], [0.0, 1 - t, eye_m[2] * t], [0.0, 0.0, 1.0]])
        return across @ self.plane_from_raster

    def frame_from_plane(self, *, x_m: float) -> F64:
        """3x3: this raster's pixels from (y, z, 1) on a parallel plane, in line as seen from between the eyes."""
        t = (x_m - self.x_m) / (self.middle_m[0] - self.x_m)
        back = np.array([[1.0, 0.0, -self.middle_m[1] * t], [0.0, 1.0, -self.middle_m[2] * t], [0.0, 0.0, 1.0 - t]]) / (
            1 - t
        )
        p = self.plane_from_raster
        determinant = p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]
        linear = np.array([[p[1, 1], -p[0, 1]], [-p[1, 0], p[0, 0]]]) / determinant
        inverse = np.eye(3)
        inverse[:2, :2], inverse[:2, 2] = linear, -linear @ p[:2, 2]
        return inverse @ back

    def doubt(self, stack: PanelStack, *, eye_sigma_mm: float) -> F32:
        """(3,): how far the outer panels' pictures move, columns and rows, for eyes off by one standard deviation to
        the right and up; and the centre panel's own parallax beside this raster's plane, in columns."""
        reach = (stack.x_m[-1] - self.x_m) / (self.middle_m[0] - stack.x_m[-1])
        centre = (self.x_m - stack.x_m[1]) / (self.middle_m[0] - stack.x_m[1])
        moved_m = eye_sigma_mm / 1e3 * reach
        (across_m, _), (along_m, down_m) = self.plane_from_raster[:2, :2]
        columns = moved_m / abs(across_m)
        rows = moved_m * np.hypot(1.0, along_m / across_m) / abs(down_m)
        return np.array([columns, rows, self.cell_px * centre / reach], np.float32)


def chain_frame(eyes_m: F64, stack: PanelStack, *, cell_px: int, reduction: int) -> ChainFrame:
    """The raster for two eyes (2, 3), left and right, frame `stack`.

    Columns are scaled so that the outer panels' parallax is `cell_px` columns; rows are `reduction` panel
    rows high and sheared along the line of the eyes. It covers what both see of all panels, and a margin.
    Raises ValueError where the eyes have no horizontal separation.
    """
    middle = eyes_m.mean(axis=0)
    half = (eyes_m[1] - eyes_m[0]) / 2
    plane_m = _equal_parallax_m(stack, middle[0])
    reach = (stack.x_m[-1] - plane_m) / (middle[0] - stack.x_m[-1])
    step_y_m, step_z_m = half[1:] * (reach / cell_px)
    if abs(step_y_m) < 1e-12:
        raise ValueError("the line of the eyes is vertical or has no length")
    low, high = _common_extent(middle, stack, plane_m=plane_m, axis=1)
    cells = ceil((high - low) / (2 * abs(step_y_m) * cell_px)) + 1
    cells = min(CELLS_MAX, CELLS_STEP * ceil(cells / CELLS_STEP))
    width = cells * 2 * cell_px
    middle_y = (low + high) / 2
    bottom, top = _panel_extent(middle, stack, plane_m=plane_m)
    pitch_v_m = (top - bottom) / (stack.height_px / reduction)
    rise_m = abs(step_z_m) * width
    step = ROWS_STEP if rise_m / pitch_v_m > 0.01 else BLOCK_ROWS
    rows = step * ceil((stack.height_px / reduction + rise_m / pitch_v_m) / step)
    middle_z = (bottom + top) / 2
    plane_from_raster = np.array(
        [
            [step_y_m, 0.0, middle_y - step_y_m * width / 2],
            [step_z_m, -pitch_v_m, middle_z - step_z_m * width / 2 + pitch_v_m * rows / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    return ChainFrame(plane_m, plane_from_raster, cells, cell_px, rows, middle)


def _equal_parallax_m(stack: PanelStack, eye_x_m: float) -> float:
    """x of the plane on which both outer panels have the same parallax: a²/ex before the centre of even gaps a."""
    rear_m, front_m, far_m = stack.x_m[1] - stack.x_m[0], stack.x_m[2] - stack.x_m[1], eye_x_m - stack.x_m[1]
    ahead = 2 * rear_m * front_m + far_m * (front_m - rear_m)
    return float(stack.x_m[1] + ahead / (2 * far_m + (rear_m - front_m)))


def _common_extent(middle: F64, stack: PanelStack, *, plane_m: float, axis: int) -> tuple[float, float]:
    """(low, high) on the plane, metres, that rays from `middle` through all panels reach; the centre's at least 10%."""
    half_m = stack.width_m / 2
    lows, highs = [], []
    for x_m in stack.x_m:
        t = (x_m - plane_m) / (middle[0] - plane_m)
        lows.append((-half_m - middle[axis] * t) / (1 - t))
        highs.append((half_m - middle[axis] * t) / (1 - t))
    low, high = max(lows), min(highs)
    if high - low < stack.width_m / 10:
        centre = (low + high) / 2
        low, high = centre - stack.width_m / 20, centre + stack.width_m / 20
    return low, high


def _panel_extent(middle: F64, stack: PanelStack, *, plane_m: float) -> tuple[float, float]:
    """(bottom, top) of the centre panel, seen on the plane, metres."""
    t = (stack.x_m[1] - plane_m) / (middle[0] - plane_m)
    half_m = stack.height_m / 2
    return (-half_m - middle[2] * t) / (1 - t), (half_m - middle[2] * t) / (1 - t)


@lru_cache(maxsize=8)
def chain_modes(cells: int) -> tuple[F32, F32, F32, F32]:
    """Modes of the chain operators, in closed form, for `cells` equations.

    The difference A (cells, cells + 1), rows [.. -2 2 ..], is U·diag(s)·V^T; the mean B, rows [.. 1/2 1/2 ..], is
    U·diag(cos)·Ũ^T with cos = sqrt(1 - s²/16): sines and cosines of the same frequencies. Returns V and Ũ
    (cells + 1, cells + 1), s (cells + 1,) and U^T (cells + 1, cells), float32; the first mode of V is what A can't see.
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
