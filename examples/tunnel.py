"""A custom scene: a tunnel behind the display, drawn with NumPy alone.

The file must be on Python's path, and the configuration must name the class:

    [content]
    scene = "tunnel:Tunnel"
    options = { radius_m = 0.15, speed_m_per_s = 0.1 }

    PYTHONPATH=examples phasestack run --config tunnel.toml --replay demo --headless --max-speed --frames 60 --out out

Coordinates are in metres from the display's centre, with x out of the screen, y to the right and z up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, Field

import phasestack

RING_M = 0.04  # length of each ring of tiles
TILES = 16  # number of tiles in a ring
DARK_AFTER_M = 0.5  # depth over which the brightness falls by a factor of e


class TunnelOptions(BaseModel):
    """The scene's options, from the [content.options] table."""

    radius_m: float = Field(0.12, gt=0.02, lt=1.0)
    speed_m_per_s: float = 0.05


class Tunnel(phasestack.ContentSource):
    """A tiled tube around the display's axis that moves towards the viewer."""

    Options = TunnelOptions

    def __init__(self, options: TunnelOptions, *, stack: Any, context: Any) -> None:
        super().__init__(options, stack=stack, context=context)
        self._options = options

    def render(self, view: Any, *, time_ns: int) -> np.ndarray:
        """Draw an eye's picture by intersecting the ray through each pixel with the tube."""
        u, v = np.meshgrid(np.arange(view.width_px) + 0.5, np.arange(view.height_px) + 0.5)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(view.pixels_from_stack[:, :3]).T
        # Find t such that eye + t·ray is on the wall. The larger of the two solutions is ahead of the eye.
        across, eye = rays[..., 1:], view.eye_m[1:]
        a, b = (across**2).sum(-1), across @ eye
        c = eye @ eye - self._options.radius_m**2
        t = (-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / np.maximum(a, 1e-9)
        wall = view.eye_m + t[..., None] * rays
        depth = -wall[..., 0]
        rings = depth / RING_M + self._options.speed_m_per_s * time_ns / 1e9 / RING_M
        tiles = np.arctan2(wall[..., 2], wall[..., 1]) / (2 * np.pi) * TILES
        light = np.exp(-np.clip(depth, 0, None) / DARK_AFTER_M)
        chequer = (np.floor(rings) + np.floor(tiles)) % 2
        picture = np.full((view.height_px, view.width_px, 4), 255, np.uint8)
        for channel, (one, other) in enumerate(((235, 40), (160, 70), (60, 120))):
            picture[..., channel] = light * np.where(chequer > 0, one, other)
        picture[(b * b < a * c) | (t <= 0) | (depth < 0)] = 0  # outside the tube: transparent black
        return picture
