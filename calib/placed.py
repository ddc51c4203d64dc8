"""Project the pixels of panels, placed at their actual poses, into eyes and cameras.

A panel's frame has its origin at the panel's centre. Its x axis points out of the screen, y points along the pixel rows
to the viewer's right, and z points up. All panels have the stack's pixel pitch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.stack import PanelStack
from runtime.records import F64

HOMOGENEOUS = np.array([0.0, 0.0, 1.0])  # row that selects the third component of a pixel (u, v, 1)


@dataclass(frozen=True, slots=True)
class PlacedPanel:
    """One panel's actual pose in the `stack` frame."""

    rotation: F64  # (3, 3) stack_from_panel
    centre_m: F64  # (3,) the panel's centre, frame `stack`

    @property
    def slope(self) -> F64:
        """The panel's slope (2,): the increase in x per metre to the right and per metre up."""
        normal = self.rotation[:, 0]
        return np.asarray(-normal[1:] / normal[0], dtype=np.float64)

    @property
    def axis_x_m(self) -> float:
        """Position where the panel's plane intersects the stack's x axis."""
        normal = self.rotation[:, 0]
        return float(normal @ self.centre_m / normal[0])


def through(matrix: F64, points_px: F64) -> F64:
    """Apply a homography (3, 3) to pixels (K, 2)."""
    moved = points_px @ matrix[:, :2].T + matrix[:, 2]
    return moved[:, :2] / moved[:, 2:]


def corner_pixels(stack: PanelStack) -> F64:
    """Return a panel's corners (4, 2) in pixels, in the order (0, 0), (W, 0), (W, H), (0, H)."""
    w, h = stack.width_px, stack.height_px
    return np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64)


def panel_from_pixels(stack: PanelStack) -> F64:
    """Return the 3x3 matrix that maps a pixel (u, v, 1) to a point in the panel's frame, in metres."""
    return replace(stack.panel(0), x_m=0.0).stack_from_raster()


def stack_from_pixels(panel: PlacedPanel, stack: PanelStack) -> F64:
    """Return the 3x3 matrix that maps a pixel (u, v, 1) to its actual position in the stack frame."""
    return panel.rotation @ panel_from_pixels(stack) + np.outer(panel.centre_m, HOMOGENEOUS)


def true_from_ideal_seen(panel: PlacedPanel, eye_m: ArrayLike, stack: PanelStack, index: int) -> F64:
    """Return the 3x3 homography from ideal to actual pixels as seen by an eye, with 1 as its last entry.

    A ray from the eye crosses panel `index`'s nominal plane at the ideal pixel, and the panel itself at the actual
    pixel. The homography depends on the eye only if the panel is tilted or is not at its nominal `x_m`. Raises
    ValueError if the eye is in the plane of the panel.
    """
    eye = np.outer(np.asarray(eye_m, dtype=np.float64), HOMOGENEOUS)
    seen = stack_from_pixels(panel, stack) - eye
    if abs(np.linalg.det(seen)) < 1e-18:
        raise ValueError("an eye in a panel's plane cannot see through the panel")
    matrix = np.linalg.solve(seen, stack.panel(index).stack_from_raster() - eye)
    return np.asarray(matrix / matrix[2, 2] + 0.0, dtype=np.float64)  # + 0.0 avoids -0.0 in files
