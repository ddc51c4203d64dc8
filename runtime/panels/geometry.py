"""Map monitor pixels to layer pixels, taking registration, mirroring and rotation into account."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from runtime.records import F64


def panel_size_px(*, screen_width_px: int, screen_height_px: int, rotation_deg: int) -> tuple[int, int]:
    """Return a panel's number of columns and of rows, as seen by the viewer."""
    if rotation_deg in (90, 270):
        return screen_height_px, screen_width_px
    return screen_width_px, screen_height_px


def panel_from_screen(*, screen_width_px: int, screen_height_px: int, rotation_deg: int, mirror: str) -> F64:
    """Return the 3x3 matrix from monitor to panel pixels as seen by the viewer; v points down in both. If
    the mounted monitor is rotated counter-clockwise by `rotation_deg`, as seen from the front, its picture is rotated
    clockwise to make up for this. Mirroring is applied to the picture as the viewer sees it, before the rotation.
    """
    width, height = float(screen_width_px), float(screen_height_px)
    turned = {
        0: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        90: [[0.0, 1.0, 0.0], [-1.0, 0.0, width], [0.0, 0.0, 1.0]],
        180: [[-1.0, 0.0, width], [0.0, -1.0, height], [0.0, 0.0, 1.0]],
        270: [[0.0, -1.0, height], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    }[rotation_deg]
    columns, rows = panel_size_px(
        screen_width_px=screen_width_px, screen_height_px=screen_height_px, rotation_deg=rotation_deg
    )
    mirrored = {
        "none": np.eye(3),
        "horizontal": np.array([[-1.0, 0.0, columns], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "vertical": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, rows], [0.0, 0.0, 1.0]]),
    }[mirror]
    result: F64 = mirrored @ np.array(turned)
    return result


def layer_from_screen(
    *,
    screen_width_px: int,
    screen_height_px: int,
    layer_width_px: int,
    layer_height_px: int,
    rotation_deg: int,
    mirror: str,
    homography: Sequence[Sequence[float]],
) -> F64:
    """Return the 3x3 matrix from monitor pixels to layer pixels, up to scale, with rotation as
    `panel_from_screen` has it. `homography` maps ideal to actual pixels, at the panel's resolution, which may not be
    the layer's. Raises ValueError if it is singular or not finite.
    """
    columns, rows = panel_size_px(
        screen_width_px=screen_width_px, screen_height_px=screen_height_px, rotation_deg=rotation_deg
    )
    true_from_ideal = np.asarray(homography, dtype=np.float64)
    if not np.isfinite(true_from_ideal).all() or abs(np.linalg.det(true_from_ideal)) < 1e-12:
        raise ValueError("the homography of a panel must be invertible")
    true_from_screen = panel_from_screen(
        screen_width_px=screen_width_px, screen_height_px=screen_height_px, rotation_deg=rotation_deg, mirror=mirror
    )
    layer_from_ideal = np.diag([layer_width_px / columns, layer_height_px / rows, 1.0])
    result: F64 = layer_from_ideal @ np.linalg.solve(true_from_ideal, true_from_screen)
    return result


def permutes_pixels(matrix: F64) -> bool:
    """Return True if a 3x3 matrix maps pixel centres to pixel centres: no interpolation is needed."""
    if matrix[2, 2] == 0.0:
        return False
    m = matrix / matrix[2, 2]
    affine = np.abs(m[2, :2]).max() < 1e-15
    turn, moved = np.rint(m[:2, :2]), (m @ np.array([0.5, 0.5, 1.0]))[:2] - 0.5
    turns = (np.abs(turn).sum(axis=0) == 1).all() and np.allclose(m[:2, :2], turn, atol=1e-12)
    return bool(affine and turns and np.allclose(moved, np.rint(moved), rtol=0.0, atol=1e-9))


Arrow = Literal["up", "down", "left", "right"]
ROTATIONS = (0, 90, 180, 270)
DIRECTIONS: dict[Arrow, tuple[int, int]] = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


def mounting_of(arrow: Arrow, *, mirrored: bool) -> tuple[int, str]:
    """Determine a panel's `rotation_deg` and `mirror` from how its test card looks."""
    mirror = "horizontal" if mirrored else "none"
    rotation_of = {}  # by the direction in which the arrow then points
    for rotation_deg in ROTATIONS:
        seen = panel_from_screen(screen_width_px=1, screen_height_px=1, rotation_deg=rotation_deg, mirror=mirror)
        rotation_of[tuple(round(value) for value in seen[:2, :2] @ [0.0, -1.0])] = rotation_deg
    return rotation_of[DIRECTIONS[arrow]], mirror
