"""Carried and expected quality against a ray tracer in plain Python floats."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.optics import carried
from runtime.optics.carried import carried_db, expected_psnrs_db, standard_error_db
from runtime.optics.light import LIGHT, ONE_RAY, Sampling
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.records import U8
from tests.optics import reference
from tests.optics.strategies import floats

SIZE = (17, 11)  # of the pictures, pixels
STACKS = (  # no line of sight is on an edge between pixels, where the nearest one is ambiguous
    PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 33, 21),
    PanelStack(0.5, 0.3, (-0.05, 0.02), 24, 16),
    PanelStack(0.4, 0.4, (-0.07, -0.03, 0.01, 0.03), 20, 20),
)


def traced_error(nominal: np.ndarray, true: np.ndarray, layers: U8, pictures: list[U8], stack: PanelStack) -> float:
    """Mean squared error of both eyes (2, 3), one ray at a time: through the centre panel's points."""
    errors = [
        error
        for eye, place, picture in zip(nominal, true, pictures, strict=True)
        for error in reference.carried_errors(tuple(eye), tuple(place), layers, picture / 255, stack, fov_deg=30)
    ]
    return sum(errors) / len(errors)


def case(stack: PanelStack, seed: int) -> tuple[U8, list[U8], np.ndarray]:
    """Layers, pictures and two eyes."""
    rng = np.random.default_rng(seed)
    layers = rng.integers(0, 256, (stack.count, stack.height_px, stack.width_px, 4), dtype=np.uint8)
    pictures = [rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8) for _ in range(2)]
    middle = np.array([rng.uniform(0.5, 1.0), rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.3)])
    return layers, pictures, middle + np.array([[0, -0.03, 0], [0.01, 0.03, 0]])


@settings(max_examples=15)
@given(st.sampled_from(STACKS), st.integers(0, 2**31), floats(-0.05, 0.05), floats(-0.05, 0.05))
def test_carried_error_is_what_the_true_eyes_rays_cross(
    stack: PanelStack, seed: int, right_m: float, away_m: float
) -> None:
    layers, pictures, eyes = case(stack, seed)
    true = eyes + np.array([away_m, right_m, 0.02])
    ours = carried_db(layers, pictures, stack, solved_for_m=eyes, eyes_m=true, fov_deg=30)
    assert ours == pytest.approx(-10 * math.log10(traced_error(eyes, true, layers, pictures, stack)), abs=1e-3)


@settings(max_examples=8)
@given(st.sampled_from(STACKS), st.integers(0, 2**31), st.sampled_from([0.5, 1.0, 2.0, 7.0]))
def test_expected_psnr_is_five_points_of_the_eyes_common_place(stack: PanelStack, seed: int, sigma_mm: float) -> None:
    layers, pictures, eyes = case(stack, seed)
    middle = (eyes[0] + eyes[1]) / 2
    right = np.array([-middle[1], middle[0], 0.0]) / math.hypot(middle[0], middle[1])
    moves = [(0.5, np.zeros(3))]
    for axis in (right, np.array([0.0, 0.0, 1.0])):
        moves += [(0.125, side * 0.002 * sigma_mm * axis) for side in (-1, 1)]
    total = sum(weight * traced_error(eyes, eyes + move, layers, pictures, stack) for weight, move in moves)
    how = {"eyes_m": eyes, "fov_deg": 30, "sigmas_mm": (sigma_mm,), "sampling": ONE_RAY}
    told = expected_psnrs_db(layers, pictures, stack, **how)[sigma_mm]
    assert told == pytest.approx(-10 * math.log10(total), abs=2e-3)


def test_at_the_eyes_solved_for_carried_quality_is_the_exact_one() -> None:
    layers, pictures, eyes = case(STACKS[0], 1)
    exact = [seen_by(eye, layers, STACKS[0], fov_deg=30, width_px=SIZE[0], height_px=SIZE[1]) for eye in eyes]
    wanted = [picture.astype(np.float32) / np.float32(255) for picture in pictures]
    expected = quality([r.image for r in exact], wanted, [r.mask for r in exact])
    told = carried_db(layers, pictures, STACKS[0], solved_for_m=eyes, eyes_m=eyes, fov_deg=30)
    assert told == pytest.approx(expected.psnr_db, abs=1e-4)
    how = {"eyes_m": eyes, "fov_deg": 30, "sigmas_mm": (0.0,), "sampling": ONE_RAY}
    sure = expected_psnrs_db(layers, pictures, STACKS[0], **how)[0.0]
    assert sure == pytest.approx(expected.psnr_db, abs=1e-4)


@pytest.mark.parametrize("sampling", [ONE_RAY, LIGHT])
def test_large_pictures_are_looked_at_by_a_part_where_eyes_are_off(
    monkeypatch: pytest.MonkeyPatch, sampling: Sampling
) -> None:
    rng = np.random.default_rng(8)
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 330, 210)
    smooth: Any = cv2.resize(
        rng.integers(0, 256, (9, 14, 3)).astype(np.uint8), (330, 210), interpolation=cv2.INTER_CUBIC
    )
    layers = rng.integers(60, 90, (3, 210, 330, 3)).astype(np.uint8)
    eyes = np.array([[0.7, -0.03, 0.1], [0.7, 0.03, 0.1]])
    how = {"eyes_m": eyes, "fov_deg": 40, "sigmas_mm": (0.0, 2.0), "sampling": sampling}
    whole = expected_psnrs_db(layers, [smooth, smooth], stack, **how)
    monkeypatch.setattr(carried, "PLENTY", 1000)
    part = expected_psnrs_db(layers, [smooth, smooth], stack, **how)
    assert part[0.0] == whole[0.0], "where they are not off, by all of them"
    assert part[2.0] != whole[2.0]
    assert part[2.0] == pytest.approx(whole[2.0], abs=0.05)


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ([0.06, 0.0, 0.0], "in front of every panel"),
        ([-1.0, 0.0, 0.0], "in front of every panel"),
        ([math.nan, 0.0, 0.0], "in front of every panel"),
        ([0.7, 50.0, 0.0], "crosses every panel"),
    ],
)
def test_a_true_eye_that_sees_nothing_of_the_panels_is_refused(place: list[float], told: str) -> None:
    layers, pictures, eyes = case(STACKS[0], 5)
    with pytest.raises(ValueError, match=told):
        carried_db(layers, pictures, STACKS[0], solved_for_m=eyes, eyes_m=[place, place], fov_deg=30)


def test_a_standard_error_is_that_of_the_mean_of_groups() -> None:
    assert standard_error_db(np.array([0.01, 0.008, 0.012, 0.01, 0.01])) == pytest.approx(0.35459, abs=1e-5)
    assert standard_error_db(np.array([0.0, 0.0, 0.0])) == 0.0
