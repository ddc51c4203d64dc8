"""Small scenes with exact geometry for tests of models: cards at known depths, seen by any eye."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from runtime.optics.quality import Quality, quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F32, F64, U8

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
FOV_DEG = 40.0


def eyes(
    distance_m: float, side_m: float = 0.0, up_m: float = 0.0, *, separation_m: float = 0.062, roll_deg: float = 0.0
) -> F64:
    """(2, 3) left and right eye, frame `stack`."""
    roll = np.radians(roll_deg)
    half = separation_m / 2 * np.array([0.0, np.cos(roll), np.sin(roll)])
    middle = np.array([distance_m, side_m, up_m])
    return np.array([middle - half, middle + half])


def sampled(image: F64 | F32, u: F64 | F32, v: F64 | F32) -> F64:
    """(..., C) exact bilinear samples of (H, W, C) at continuous pixels, edges clamped."""
    places = np.array([v, u], np.float64) - 0.5
    planes = [map_coordinates(plane, places, order=1, mode="nearest") for plane in np.moveaxis(image, 2, 0)]
    return np.stack(planes, axis=-1)


def card_scene(eye_m: F64, *, seed: int = 0, width_px: int = 480, height_px: int = 270) -> U8:
    """(h, w, 3) what an eye sees of a few textured cards before and behind the panels, at 40 degrees."""
    rng = np.random.default_rng(seed)
    cards = [(-0.10, 0.0, 0.0, 0.9)]
    cards += [
        (x, rng.uniform(-0.15, 0.15), rng.uniform(-0.08, 0.08), rng.uniform(0.08, 0.2)) for x in (-0.05, 0.0, 0.05)
    ]
    projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=FOV_DEG)
    picture = np.full((height_px, width_px, 3), 255, np.float32)
    v, u = np.mgrid[0:height_px, 0:width_px] + 0.5
    for x_m, y_m, z_m, size_m in cards:
        texture = rng.integers(30, 226, (24, 24, 3)).astype(np.float32)
        texture = texture.repeat(4, 0).repeat(4, 1)
        card = PlaneRaster(x_m, y_m - size_m / 2, z_m + size_m / 2, size_m / 96, size_m / 96, 96, 96)
        back = np.linalg.inv(image_from_raster(projection, card))
        weight = back[2, 0] * u + back[2, 1] * v + back[2, 2]
        s = ((back[0, 0] * u + back[0, 1] * v + back[0, 2]) / weight).astype(np.float32)
        t = ((back[1, 0] * u + back[1, 1] * v + back[1, 2]) / weight).astype(np.float32)
        inside = (s > 0) & (s < 96) & (t > 0) & (t < 96)
        picture[inside] = sampled(texture, s, t)[inside]
    return np.rint(picture).astype(np.uint8)


def displayed(layers: U8, pair: F64, stack: PanelStack, *, seed: int = 0) -> Quality:
    """PSNR of two eyes' views of layers against the card scene."""
    retinas = [seen_by(eye, layers, stack, fov_deg=FOV_DEG) for eye in pair]
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    wanted = [card_scene(eye, seed=seed, **size).astype(np.float32) / np.float32(255) for eye in pair]
    return quality([r.image for r in retinas], wanted, [r.mask for r in retinas])


__all__ = ["FOV_DEG", "STACK", "card_scene", "displayed", "eyes"]
