"""Random pairs as pictures of two eyes, for checks over the whole design range. Needs no torch."""

from __future__ import annotations

import math

import numpy as np

from model_export.data import random_place
from model_export.scene import draw, random_scene
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64
from runtime.report.pairs import StillPair

WIDEST_DEG = 100.0


def random_still(seed: int, number: int, *, width_px: int, height_px: int) -> StillPair:
    """Pair `number` of a seed's endless row: made from these two alone, each eye's picture drawn from its place."""
    random = np.random.default_rng([seed, number])
    stack, eyes = random_place(random, width_px=width_px, height_px=height_px)
    scene = random_scene(random, stack, eyes.mean(axis=0))
    fov_deg = filling_fov_deg(stack, eyes.mean(axis=0))
    size = {"width_px": width_px, "height_px": height_px}
    left, right = (draw(scene, image_from_stack(eye, **size, fov_deg=fov_deg), **size) for eye in eyes)
    return StillPair(f"{seed}-{number}", stack, eyes, (left, right), fov_deg)


def filling_fov_deg(stack: PanelStack, eye_m: F64) -> float:
    """The horizontal field of view that the panels fill as seen from before them, WIDEST_DEG at most."""
    distance_m = float(np.linalg.norm(eye_m))
    return min(WIDEST_DEG, math.degrees(2 * math.atan(stack.width_m / 2 / distance_m)))
