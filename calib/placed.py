"""Panels at their actual poses, and their projections into eyes and cameras.

A panel's own frame has its origin at the panel's middle and the axes of `stack`: x out of the screen, y along the
rows to the viewer's right, z up. Its pixel pitch is that of the stack.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.stack import PanelStack
from runtime.records import F64

HOMOGENEOUS = np.array([0.0, 0.0, 1.0])  # selects the third component of a pixel (u, v, 1)


@dataclass(frozen=True, slots=True)
class PlacedPanel:
    """Pose of one panel."""

    rotation: F64  # (3, 3) stack_from_panel
    centre_m: F64  # (3,) frame `stack`

    @property
    def slope(self) -> F64:
        """Increase of x per metre to the right and per metre up, (2,)."""
        normal = self.rotation[:, 0]
        return np.asarray(-normal[1:] / normal[0], dtype=np.float64)

    @property
    def axis_x_m(self) -> float:
        """x at which the panel's plane meets the axis y = z = 0 of the stack."""
        normal = self.rotation[:, 0]
        return float(normal @ self.centre_m / normal[0])


def through(matrix: F64, points_px: F64) -> F64:
    """Apply a 3x3 homography to pixels (K, 2)."""
    moved = points_px @ matrix[:, :2].T + matrix[:, 2]
    return moved[:, :2] / moved[:, 2:]


def corner_pixels(stack: PanelStack) -> F64:
    """Return the corners of a panel in pixels (4, 2): (0, 0), (W, 0), (W, H), (0, H)."""
    w, h = stack.width_px, stack.height_px
    return np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64)


def panel_from_pixels(stack: PanelStack) -> F64:
    """Return the 3x3 matrix from a pixel (u, v, 1) to a point in the panel's frame, in metres."""
    return replace(stack.panel(0), x_m=0.0).stack_from_raster()


def stack_from_pixels(panel: PlacedPanel, stack: PanelStack) -> F64:
    """Return the 3x3 matrix from an actual pixel (u, v, 1) to a point in the stack frame, in metres."""
    return panel.rotation @ panel_from_pixels(stack) + np.outer(panel.centre_m, HOMOGENEOUS)


def true_from_ideal_seen(panel: PlacedPanel, eye_m: ArrayLike, stack: PanelStack, index: int) -> F64:
    """Return the 3x3 homography from ideal to actual pixels as an eye sees them, with last entry 1.

    A ray of the eye crosses the nominal plane of panel `index` at the ideal pixel, and the panel itself at the actual
    one. The result depends on the eye only if the panel is tilted or not at its x_m. Raises ValueError for an eye in
    the panel's plane.
    """
    eye = np.outer(np.asarray(eye_m, dtype=np.float64), HOMOGENEOUS)
    seen = stack_from_pixels(panel, stack) - eye
    if abs(np.linalg.det(seen)) < 1e-18:
        raise ValueError("an eye in a panel's plane cannot see through the panel")
    matrix = np.linalg.solve(seen, stack.panel(index).stack_from_raster() - eye)
    return np.asarray(matrix / matrix[2, 2] + 0.0, dtype=np.float64)  # + 0.0 avoids -0.0 in files
