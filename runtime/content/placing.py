"""Where a scene's own coordinates lie in the stack frame: a preset's similarity, or a fit to the display."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from runtime.config import ContentSettings
from runtime.content.presets import axes_matrix
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import F64

FILL = 0.85  # of the display's width and height that a fitted scene takes
FARTHEST_VIEWER_M = 1.5
Z_UP = (".ply", ".stl")


def axes_of(settings: ContentSettings, path: Path) -> F64:
    """3x3 scene_from_stack rotation of a file: glTF and OBJ have y up and face +z; PLY and STL have z up, face +x."""
    if settings.up != "auto" and settings.out != "auto":
        return axes_matrix(out=settings.out, up=settings.up)
    if path.suffix.lower() in Z_UP:
        return axes_matrix(out="+x", up="+z")
    return axes_matrix(out="+z", up="+y")


def fitted(low: F64, high: F64, *, axes: F64, stack: PanelStack, depth_m: tuple[float, float]) -> F64:
    """4x4 stack_from_scene that centres a box and scales it until the display's width, height or `depth_m` is full.

    low, high: (3,) corners in the scene's coordinates; axes: 3x3 scene_from_stack rotation.
    """
    size = np.abs(axes.T @ (high - low))
    room = np.array([depth_m[1] - depth_m[0], stack.width_m * FILL, stack.height_m * FILL])
    with np.errstate(divide="ignore"):
        scale = float(np.min(np.where(size > 0, room / np.where(size > 0, size, 1.0), np.inf)))
    if not np.isfinite(scale):
        scale = 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = axes.T * scale
    matrix[:3, 3] = [sum(depth_m) / 2, 0.0, 0.0] - matrix[:3, :3] @ ((low + high) / 2)
    return matrix


def stack_from_scene(
    low: F64,
    high: F64,
    *,
    settings: ContentSettings,
    path: Path,
    stack: PanelStack,
    scene_from_stack: F64 | None,
) -> F64:
    """4x4 of a loaded scene: the preset's where there is one, else fitted, else its own metres on the stack's axes.

    Raises InputError for a scene that lies wholly behind every viewer.
    """
    axes = axes_of(settings, path)
    if scene_from_stack is not None:
        matrix = np.asarray(np.linalg.inv(scene_from_stack), dtype=np.float64)
    elif settings.fit:
        matrix = fitted(low, high, axes=axes, stack=stack, depth_m=settings.depth_m)
    else:
        matrix = np.eye(4)
        matrix[:3, :3] = axes.T
    nearest_m = float(_corner_x(matrix, low, high).min())
    if nearest_m > FARTHEST_VIEWER_M:
        raise InputError(path, "position", f"the scene begins at x = {nearest_m:.2f} m, wholly behind the viewer")
    return matrix


def _corner_x(matrix: F64, low: F64, high: F64) -> F64:
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    found: F64 = corners @ matrix[0, :3] + matrix[0, 3]
    return found
