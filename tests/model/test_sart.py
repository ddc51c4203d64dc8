"""The literature's solver: what one turn is, and that it serves any stack."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.model.job import drawn_job
from runtime.model.sart import RELAXATION, SartPredictor
from runtime.model.still import solve_still
from runtime.optics.malus import intensity_from_phase, rest_value
from runtime.optics.stack import PanelStack
from tests.model.scenes import card_scene, displayed, eyes


def stack_of(count: int) -> PanelStack:
    return PanelStack(0.5184, 0.2916, tuple(np.linspace(-0.06, 0.06, count)), 240, 135)


def pictures(stack: PanelStack) -> list[np.ndarray]:
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    alpha = np.full((135, 240, 1), 255, np.uint8)
    return [np.concatenate([card_scene(eye, **size), alpha], axis=2) for eye in eyes(0.6)]


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("code", [40, 128, 230])
def test_a_turn_corrects_an_even_picture_by_the_relaxation(count: int, code: int) -> None:
    stack = stack_of(count)
    grey = np.full((135, 240, 4), code, np.uint8)
    layers = SartPredictor(stack, iterations=1).solve(drawn_job([grey, grey], eyes(0.6), stack)).layers
    sums = layers[..., :3].astype(np.float64).sum(axis=0)[60:70, 100:140] / 255
    rest = count * rest_value(count)
    target = rest + (sums - rest) / RELAXATION  # the sum that a whole correction would have reached
    assert np.abs(intensity_from_phase(target) * 255 - code).max() <= 4  # half a code of each panel


@pytest.mark.parametrize("count", [2, 3, 4])
def test_both_eyes_are_served_alike_and_more_turns_serve_them_better(count: int) -> None:
    stack, pair = stack_of(count), eyes(0.6)
    shown = []
    for turns in (1, 10):
        solver = SartPredictor(stack, iterations=turns)
        stills = pictures(stack)
        shown.append(displayed(solve_still(*stills, eyes_m=pair, fov_deg=40.0, predictor=solver).layers, pair, stack))
    assert shown[1].psnr_db > shown[0].psnr_db
    assert abs(shown[1].eye_psnr_db[0] - shown[1].eye_psnr_db[1]) < 2.0


def test_layers_are_rgba_of_8_bits_without_transparency() -> None:
    stack = stack_of(3)
    layers = SartPredictor(stack).solve(drawn_job(pictures(stack), eyes(0.6), stack)).layers
    assert layers.shape == (3, 135, 240, 4) and layers.dtype == np.uint8
    assert (layers[..., 3] == 255).all()
