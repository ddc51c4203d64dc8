"""Tests that the solution meter measures light as `light_db` does."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from runtime.frame.meter import sampled_light
from runtime.model.job import Job, Targets
from runtime.model.still import captured_views
from runtime.optics.light import LIGHT, squared_errors
from runtime.optics.stack import PanelStack, Tilt

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54)
TILTED = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54, Tilt(((0.0, 0.02, -0.01),) * 3, (0.5, 0.0, 0.0)))
EYES = np.array([[0.6, -0.031, 0.02], [0.6, 0.031, 0.02]])
FOV_DEG = 40.0


def smooth(*shape: int, seed: int) -> np.ndarray:
    """(n, h, w, 3) codes that change over some pixels."""
    coarse = np.random.default_rng(seed).integers(0, 256, (shape[0], 9, 16, 3), np.uint8)
    return np.stack([cv2.resize(one, (shape[2], shape[1]), interpolation=cv2.INTER_CUBIC) for one in coarse])


@pytest.mark.parametrize("stack", [STACK, TILTED], ids=["parallel", "tilted"])
def test_the_residual_is_the_error_of_the_light_at_pinhole_eyes(stack: PanelStack) -> None:
    layers, pictures = smooth(3, 54, 96, seed=1), smooth(2, 54, 96, seed=2)
    job = Job(Targets(stack, EYES, captured_views(list(pictures), EYES, stack, fov_deg=FOV_DEG)))
    places = np.random.default_rng(3).random((2, 16_000, 2))
    found = sampled_light(layers, job, places, boxes=True)
    targets = [picture.astype(np.float32) / 255 for picture in pictures]
    sampling = LIGHT._replace(pupil_mm=0.0, rays=4)
    expected = squared_errors(
        layers, targets, stack, solved_for_m=EYES, eyes_m=EYES, fov_deg=FOV_DEG, sampling=sampling
    )[0]
    assert found == pytest.approx(expected, rel=0.05)


def test_a_coarse_solution_is_interpolated() -> None:
    """Otherwise, its pixels would be visible as squares."""
    layers, pictures = smooth(3, 54, 96, seed=1), smooth(2, 54, 96, seed=2)
    job = Job(Targets(STACK, EYES, captured_views(list(pictures), EYES, STACK, fov_deg=FOV_DEG)))
    places = np.random.default_rng(3).random((2, 4_000, 2))
    boxes, enlarged = (sampled_light(layers, job, places, boxes=boxes) for boxes in (True, False))
    assert boxes is not None and enlarged is not None and boxes != enlarged


def test_rays_that_miss_the_panels_have_no_error() -> None:
    away = np.array([[0.6, 5.0, 0.0], [0.6, 5.1, 0.0]])
    pictures = smooth(2, 54, 96, seed=2)
    job = Job(Targets(STACK, away, captured_views(list(pictures), EYES, STACK, fov_deg=FOV_DEG)))
    assert (
        sampled_light(smooth(3, 54, 96, seed=1), job, np.random.default_rng(3).random((2, 100, 2)), boxes=True) is None
    )
