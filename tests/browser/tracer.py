"""Traces an eye's light through layers ray by ray, without code of the runtime."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

EVEN = 128


@dataclass(frozen=True)
class Panels:
    """Planes x = x_m + right·y + up·z; a pixel of a layer is where `seen_from` sees it on x = x_m."""

    width_m: float
    height_m: float
    x_m: tuple[float, ...]
    tilt: tuple[tuple[float, float], ...] = ()
    seen_from_m: tuple[float, float, float] = (0.5, 0.0, 0.0)
    reference: int = field(default=1)

    def crossed(self, n: int, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """y and z on the ideal panel n of the layer's point where rays (..., 3) from an eye cross it."""
        right, up = self.tilt[n] if self.tilt else (0.0, 0.0)
        normal = np.array([1.0, -right, -up])
        point = eye + rays * ((self.x_m[n] - normal @ eye) / (rays @ normal))[..., None]
        if right or up:
            seen = np.array(self.seen_from_m)
            point = seen + (point - seen) * ((self.x_m[n] - seen[0]) / (point[..., 0] - seen[0]))[..., None]
        return point[..., 1], point[..., 2]

    def aligned(self, layers: np.ndarray, solved: np.ndarray, now: np.ndarray) -> np.ndarray:
        """Layers aligned to a moved head: each pixel's centre follows the new middle's ray to the centre panel, and the
        old middle's ray back to its own panel."""
        height, width = layers.shape[1:3]
        old, new, r = solved.mean(axis=0), now.mean(axis=0), self.x_m[self.reference]
        v, u = np.mgrid[0:height, 0:width] + 0.5
        y, z = (u / width - 0.5) * self.width_m, (0.5 - v / height) * self.height_m
        shown = []
        for layer, x in zip(layers, self.x_m, strict=True):
            on = [new[k] + (p - new[k]) * (r - new[0]) / (x - new[0]) for k, p in ((1, y), (2, z))]
            on = [old[k] + (c - old[k]) * (x - old[0]) / (r - old[0]) for k, c in zip((1, 2), on, strict=True)]
            a, b = (on[0] / self.width_m + 0.5) * width - 0.5, (0.5 - on[1] / self.height_m) * height - 0.5
            padded = np.full((height + 4, width + 4, 3), EVEN, float)
            padded[2:-2, 2:-2] = layer[..., :3]
            a, b = np.clip(a + 2, 0, width + 2.5), np.clip(b + 2, 0, height + 2.5)
            i, j = a.astype(int), b.astype(int)
            fa, fb = (a - i)[..., None], (b - j)[..., None]
            top, below = (padded[k, i] * (1 - fa) + padded[k, i + 1] * fa for k in (j, j + 1))
            shown.append(np.floor(top * (1 - fb) + below * fb + 0.5))
        return np.array(shown)


def light(
    layers: np.ndarray, panels: Panels, eye: np.ndarray, *, rows: np.ndarray, columns: np.ndarray, rays: int = 14
) -> tuple[np.ndarray, np.ndarray]:
    """Mean intensity (rows, columns, 3) of `rays` by `rays` rays through some pixels of a picture as large as the
    layers and 40 degrees wide, and which of them cross every panel."""
    height, width = layers.shape[1:3]
    z = eye / np.linalg.norm(eye)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(z, x), z])
    focal = width / 2 / math.tan(math.radians(20))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    total, inside = np.zeros((*u.shape, 3)), np.ones(u.shape, bool)
    for k in range(rays * rays):
        right, down = (k % rays + 0.5) / rays, (k // rays + 0.5) / rays
        ray = np.stack([(u + right - width / 2) / focal, (height / 2 - v - down) / focal, -np.ones(u.shape)], -1) @ turn
        phase = np.zeros((*u.shape, 3))
        for n, layer in enumerate(layers):
            y, up = panels.crossed(n, eye, ray)
            a, b = (y / panels.width_m + 0.5) * width, (0.5 - up / panels.height_m) * height
            inside &= (a > 0.5) & (a < width - 0.5) & (b > 0.5) & (b < height - 0.5)
            phase += layer[np.clip(b, 0, height - 1).astype(int), np.clip(a, 0, width - 1).astype(int), :3] / 255
        total += np.sin(phase * math.pi / 2) ** 2
    return total / rays**2, inside
