"""Stacks as hands build them: gaps that differ a little, panels that are tilted a little."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.model.chain import chain_frame
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.model.warp import resample
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack, Tilt

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
EYES = np.array([[0.5, -0.031, 0.0], [0.5, 0.031, 0.0]])
FOV = 40.0
TILT = Tilt(((0.0, 0.04, -0.03), (0.0, 0.0, 0.0), (0.0, -0.03, 0.04)), (0.5, 0.0, 0.0))


def pictures() -> Any:
    """Two smooth pictures that differ."""
    v, u = np.mgrid[0 : STACK.height_px, 0 : STACK.width_px]
    found = []
    for shift in (0, 7):
        wave = [127 + 90 * np.sin((u + shift) / (9 + 3 * k)) * np.cos(v / (11 + 2 * k)) for k in range(3)]
        found.append(np.stack([*wave, np.full(u.shape, 255.0)], axis=-1).astype(np.uint8))
    return found


def displayed_db(solved_for: Any, seen_on: Any, *, model: str = "balanced", eyes: Any = EYES) -> Any:
    left, right = pictures()
    predictor = load_predictor(model, solved_for)
    try:
        layers = solve_still(left, right, eyes_m=eyes, fov_deg=FOV, predictor=predictor).layers
        retinas = [seen_by(eye, layers, seen_on, fov_deg=FOV) for eye in eyes]
    finally:
        predictor.close()
    targets = [picture[..., :3].astype(np.float32) / 255 for picture in (left, right)]
    return quality([r.image for r in retinas], targets, [r.mask for r in retinas]).psnr_db


@pytest.mark.parametrize("share", [-0.14, -0.05, 0.05, 0.14])
def test_gaps_that_differ_a_little_are_served_by_the_network(share: float) -> None:
    uneven = replace(STACK, x_m=(-0.06 * (1 - share / 2), 0.0, 0.06 * (1 + share / 2)))
    predictor = load_predictor("balanced", uneven)
    assert predictor.facts.name == "balanced"
    predictor.close()
    assert displayed_db(uneven, uneven) > displayed_db(STACK, STACK) - 1.0


def test_uneven_gaps_are_served_without_the_network_and_named_so() -> None:
    predictor = load_predictor("balanced", replace(STACK, x_m=(-0.06, 0.0, 0.03)))
    assert predictor.facts.name.startswith("balanced (without its network")


@pytest.mark.parametrize("x_m", [(-0.06, 0.0, 0.06), (-0.058, 0.001, 0.065)])
def test_the_chain_runs_where_both_outer_panels_have_one_parallax(x_m: tuple[float, float, float]) -> None:
    frame = chain_frame(EYES, replace(STACK, x_m=x_m), most_cell_px=4, reduction=2)
    rear, front = (abs(x - frame.x_m) / (EYES[0, 0] - x) for x in (x_m[0], x_m[2]))
    assert rear == pytest.approx(front, rel=1e-12)


def test_tilts_that_are_known_are_solved_for() -> None:
    tilted = replace(STACK, tilt=TILT)
    known, unknown, parallel = (displayed_db(a, b) for a, b in ((tilted, tilted), (STACK, tilted), (STACK, STACK)))
    assert known > unknown + 0.5
    assert known > parallel - 2.0


def test_eyes_above_each_other_see_tilted_panels_too() -> None:
    upright = np.array([[0.5, 0.0, 0.031], [0.5, 0.0, -0.031]])
    tilted = replace(STACK, tilt=TILT)
    assert displayed_db(tilted, tilted, eyes=upright) > displayed_db(STACK, tilted, eyes=upright) + 0.5


def test_a_perspective_is_resampled_where_it_belongs() -> None:
    v, u = np.mgrid[0:60, 0:90].astype(np.float64) + 0.5
    image = np.rint(10 * u + 7 * v).astype(np.int16)
    matrix = np.array([[1.01, 0.02, 2.0], [-0.01, 0.99, 1.5], [1e-4, -2e-4, 1.0]])
    found = resample(image, matrix, size=(40, 70))
    x, y, weight = np.einsum("ij,jhw->ihw", matrix, np.stack([u[:40, :70], v[:40, :70], np.ones((40, 70))]))
    assert np.abs(found - (10 * x / weight + 7 * y / weight))[2:-2, 2:-2].max() < 1.5
