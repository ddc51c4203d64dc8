"""How a panel is mounted, from what a person sees of an identity card that is sent to its monitor as it is."""

from __future__ import annotations

from typing import Literal

from runtime.panels.geometry import panel_from_screen

Arrow = Literal["up", "down", "left", "right"]
ROTATIONS = (0, 90, 180, 270)
DIRECTIONS: dict[Arrow, tuple[int, int]] = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


def mounting_of(arrow: Arrow, *, mirrored: bool) -> tuple[int, str]:
    """`rotation_deg` and `mirror` of a panel on whose card the arrow that should point up points elsewhere.

    mirrored: its writing reads the wrong way round.
    """
    mirror = "horizontal" if mirrored else "none"
    for rotation_deg in ROTATIONS:
        seen = panel_from_screen(screen_width_px=1, screen_height_px=1, rotation_deg=rotation_deg, mirror=mirror)
        if tuple(round(value) for value in seen[:2, :2] @ [0.0, -1.0]) == DIRECTIONS[arrow]:
            return rotation_deg, mirror
    raise ValueError(f"no mounting makes an arrow point {arrow}")
