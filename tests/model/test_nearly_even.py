"""Stacks as hands build them: gaps that differ a little, panels that are tilted a little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from runtime.model.chain import chain_frame
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.model.warp import resample
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F64
from tests.model.scenes import FOV_DEG, STACK, card_scene, displayed, eyes

EYES = eyes(0.5)
TILTED = replace(STACK, tilt=Tilt(((0.0, 0.04, -0.03), (0.0, 0.0, 0.0), (0.0, -0.03, 0.04)), (0.5, 0.0, 0.0)))


def displayed_db(solved_for: PanelStack, seen_on: PanelStack, *, at: F64 = EYES) -> float:
    predictor = load_predictor("balanced", solved_for)
    pictures = [card_scene(eye) for eye in at]
    layers = solve_still(*pictures, eyes_m=at, fov_deg=FOV_DEG, predictor=predictor).layers
    return displayed(layers, at, seen_on).psnr_db


@pytest.mark.parametrize("share", [-0.14, -0.05, 0.05, 0.14])
def test_gaps_that_differ_a_little_are_served_by_the_network(share: float) -> None:
    uneven = replace(STACK, x_m=(-0.06 * (1 - share / 2), 0.0, 0.06 * (1 + share / 2)))
    assert load_predictor("balanced", uneven).name == "balanced"
    assert displayed_db(uneven, uneven) > displayed_db(STACK, STACK) - 2.0


@pytest.mark.parametrize("x_m", [(-0.06, 0.0, 0.06), (-0.058, 0.001, 0.065)])
def test_the_chain_runs_where_both_outer_panels_have_one_parallax(x_m: tuple[float, float, float]) -> None:
    frame = chain_frame(EYES, replace(STACK, x_m=x_m), most_cell_px=4, reduction=2)
    rear, front = (abs(x - frame.x_m) / (EYES[0, 0] - x) for x in (x_m[0], x_m[2]))
    assert rear == pytest.approx(front, rel=1e-12)


@pytest.mark.parametrize("at", [EYES, eyes(0.5, roll_deg=90)], ids=["level", "above each other"])
def test_tilts_that_are_known_are_solved_for(at: F64) -> None:
    cases = (TILTED, TILTED), (STACK, TILTED), (STACK, STACK)
    known, unknown, parallel = (displayed_db(*stacks, at=at) for stacks in cases)
    assert known > unknown + 0.5
    assert known > parallel - 2.0


def test_a_perspective_is_resampled_where_it_belongs() -> None:
    v, u = np.mgrid[0:60, 0:90].astype(np.float64) + 0.5
    image = np.rint(10 * u + 7 * v).astype(np.int16)
    matrix = np.array([[1.01, 0.02, 2.0], [-0.01, 0.99, 1.5], [1e-4, -2e-4, 1.0]])
    found = resample(image, matrix, size=(40, 70))
    x, y, weight = np.einsum("ij,jhw->ihw", matrix, np.stack([u[:40, :70], v[:40, :70], np.ones((40, 70))]))
    assert np.abs(found - (10 * x / weight + 7 * y / weight))[2:-2, 2:-2].max() < 1.5
