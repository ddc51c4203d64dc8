"""Generate random training pairs: pictures of textured planes as seen from random eye positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from model_export.scene import Random, draw, random_scene
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.records import F64, U8, Eyes

PITCH_WIDTH_M = 0.5184  # the prototype panels' width
CENTRE = 1  # index of the middle panel of three
WIDEST_DEG = 100.0  # largest horizontal field of view of a training picture
LEAST_COMMON = 0.4  # share of the middle panel's width and height that each eye must see through all panels


@dataclass(frozen=True, slots=True)
class TrainingPair:
    """A pair of pictures, with the panels and the eye positions that they were rendered for."""

    stack: PanelStack
    eyes_m: Eyes  # (2, 3) left and right eye, frame `stack`
    images: tuple[U8, U8]  # (h, w, 3) pictures for the left and the right eye
    fov_deg: float  # horizontal field of view of both pictures


def random_stack(random: Random, *, width_px: int, height_px: int) -> PanelStack:
    """Return three evenly spaced panels of random width, with a random gap between them."""
    width_m = PITCH_WIDTH_M * math.exp(random.uniform(math.log(0.25), math.log(1.6)))
    gap_m = math.exp(random.uniform(math.log(0.005), math.log(0.5)))
    if random.random() < 0.6:  # most stacks have a practical gap
        gap_m = random.uniform(0.01, 0.12)
    return PanelStack(width_m, width_m * height_px / width_px, (-gap_m, 0.0, gap_m), width_px, height_px)


def random_eyes(random: Random, stack: PanelStack) -> F64:
    """Return random (2, 3) eyes in `stack`, of a head that may be rolled and turned. It is 0.1 to 4 m
    from the origin and at least 0.1 m in front of the panels.
    """
    front_m = stack.x_m[-1]
    distance_m = math.exp(random.uniform(math.log(0.1 + front_m), math.log(4.0)))
    if random.random() < 0.5:
        distance_m = random.uniform(0.35, 1.5) + front_m
    angle = math.radians(70) * random.uniform(-1, 1) * random.random()
    rise = math.radians(35) * random.uniform(-1, 1) * random.random()
    middle = distance_m * np.array([math.cos(angle) * math.cos(rise), math.sin(angle) * math.cos(rise), math.sin(rise)])
    middle[0] = max(middle[0], front_m + 0.1)
    separation_m = random.uniform(0.055, 0.070) if random.random() < 0.85 else random.uniform(0.015, 0.055)
    pose = stack_from_eye(middle)[:3, :3]
    roll = math.radians(20) * random.uniform(-1, 1) * random.random()
    turn = math.radians(30) * random.uniform(-1, 1) * random.random()
    right = pose @ np.array([math.cos(roll) * math.cos(turn), math.sin(roll) * math.cos(turn), math.sin(turn)])
    eyes = np.array([middle - right * separation_m / 2, middle + right * separation_m / 2])
    eyes[:, 0] = np.maximum(eyes[:, 0], front_m + 0.09)
    return eyes


def is_served(eyes_m: Eyes, stack: PanelStack) -> bool:
    """Return True if each eye (2, 3) sees at least `LEAST_COMMON` of the middle panel through all panels."""
    for x_m, *aside_m in eyes_m:
        t = (np.array(stack.x_m) - stack.x_m[CENTRE]) / (x_m - stack.x_m[CENTRE])
        for size_m, eye_m in zip((stack.width_m, stack.height_m), aside_m, strict=True):
            low, high = ((edge_m - eye_m * t) / (1 - t) for edge_m in (-size_m / 2, size_m / 2))
            if high.min() - low.max() < LEAST_COMMON * size_m:
                return False
    return True


def random_place(
    random: Random, *, width_px: int, height_px: int, stack: PanelStack | None = None
) -> tuple[PanelStack, F64]:
    """Return `stack`, or random panels of this size in pixels, and random (2, 3) eyes served by them."""
    while True:
        panels = stack or random_stack(random, width_px=width_px, height_px=height_px)
        eyes = random_eyes(random, panels)
        if is_served(eyes, panels):
            return panels, eyes


def random_pair(
    random: Random, *, width_px: int, height_px: int, stack: PanelStack | None = None, fov_deg: float = 0.0
) -> TrainingPair:
    """Draw a random scene as seen from random eyes, on `stack` or on random panels of the pictures' size.
    With `fov_deg` 0, the pictures are as wide as the panels.
    """
    stack, eyes = random_place(random, width_px=width_px, height_px=height_px, stack=stack)
    scene = random_scene(random, stack, eyes.mean(axis=0))
    fov_deg = fov_deg or filling_fov_deg(stack, eyes.mean(axis=0))
    size = {"width_px": width_px, "height_px": height_px}
    left, right = (draw(scene, image_from_stack(eye, **size, fov_deg=fov_deg), **size) for eye in eyes)
    return TrainingPair(stack, eyes, (left, right), fov_deg)


def filling_fov_deg(stack: PanelStack, eye_m: F64) -> float:
    """Return the angle subtended by the panels' width at an eye's distance, at most `WIDEST_DEG`."""
    distance_m = float(np.linalg.norm(eye_m))
    return min(WIDEST_DEG, math.degrees(2 * math.atan(stack.width_m / 2 / distance_m)))
