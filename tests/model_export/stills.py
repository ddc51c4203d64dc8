"""Random pairs as pictures of two eyes, for checks over the whole design range. Needs no torch."""

from __future__ import annotations

import math

import numpy as np

from model_export.data import random_place
from model_export.scene import random_scene, view
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.records import F64
from runtime.report.pairs import OffView, StillPair

WIDEST_DEG = 100.0


def random_still(seed: int, number: int, *, width_px: int, height_px: int, beside_mm: float | None = None) -> StillPair:
    """Pair `number` of a seed's endless row: made from these two alone, each eye's picture drawn from its place.

    beside_mm: also what the eyes should see so far to the right, above, to the left and below; left eye, right eye.
    """
    random = np.random.default_rng([seed, number])
    stack, eyes = random_place(random, width_px=width_px, height_px=height_px)
    scene = random_scene(random, stack, eyes.mean(axis=0))
    fov_deg = filling_fov_deg(stack, eyes.mean(axis=0))
    size = {"width_px": width_px, "height_px": height_px, "fov_deg": fov_deg}
    left, right = (view(scene, eye, **size) for eye in eyes)  # type: ignore[arg-type]
    off = []
    if beside_mm is not None:
        for angle in np.arange(4) * (math.pi / 2):
            for eye in eyes:
                pose = stack_from_eye(eye)
                place = eye + beside_mm / 1000 * (math.cos(angle) * pose[:3, 0] + math.sin(angle) * pose[:3, 1])
                off.append(OffView(beside_mm, place, view(scene, place, **size)))  # type: ignore[arg-type]
    return StillPair(f"{seed}-{number}", stack, eyes, (left, right), fov_deg, tuple(off))


def filling_fov_deg(stack: PanelStack, eye_m: F64) -> float:
    """The horizontal field of view that the panels fill as seen from before them, WIDEST_DEG at most."""
    distance_m = float(np.linalg.norm(eye_m))
    return min(WIDEST_DEG, math.degrees(2 * math.atan(stack.width_m / 2 / distance_m)))
