"""Registration from verniers: a misaligned stack is recovered, with an uncertainty that is true."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from calib.cost_run import misaligned
from calib.registration import (
    Setting,
    error_over_panel_px,
    ideal_partner,
    parts,
    register,
    through,
    true_from_ideal,
)
from calib.vernier import nominal, simulate
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)
EYE = (0.5, 0.02, -0.01)
SIZE = {"width_px": 1920, "height_px": 1080}


def settings_of(
    truth: list[NDArray[np.float64]],
    *,
    noise_px: float = 0.0,
    off_m: tuple[int, int, int] = (0, 0, 0),
    seed: int = 0,
    stack: PanelStack = STACK,
    reference: int = 1,
) -> list[Setting]:
    asked = nominal(EYE, stack, reference=reference)
    random = np.random.default_rng(seed)
    return simulate(asked, stack, truth, noise_px=noise_px, viewpoint_error_m=np.array(off_m), random=random)


@given(
    st.tuples(st.floats(0.2, 2), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2)), st.floats(50, 1800), st.floats(50, 1000)
)
def test_partners_lie_on_one_ray(eye: tuple[float, float, float], u: float, v: float) -> None:
    """Against the projection into the eye's image: two pixels on one ray have one image."""
    partner = ideal_partner(np.array([[u, v]]), eye, STACK, reference=0, panel=2)
    projection = image_from_stack(eye, width_px=1920, height_px=1080, fov_deg=40)
    first = through(image_from_raster(projection, STACK.panel(0)), np.array([[u, v]]))
    second = through(image_from_raster(projection, STACK.panel(2)), partner)
    np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-6)


@given(st.lists(st.floats(-20, 20), min_size=8, max_size=8))
def test_a_homography_moves_the_corners_as_it_was_told(corners: list[float]) -> None:
    displacement = np.array(corners).reshape(4, 2)
    ideal = np.array([[0, 0], [1920, 0], [1920, 1080], [0, 1080]], dtype=float)
    matrix = true_from_ideal(displacement, **SIZE)
    np.testing.assert_allclose(through(matrix, ideal), ideal + displacement, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("reference", range(3))
def test_exact_settings_give_the_misalignment_back(seed: int, reference: int) -> None:
    truth = misaligned(STACK, reference=reference, random=np.random.default_rng(seed))
    found = register(settings_of(truth, reference=reference), STACK, reference=reference)
    for panel, matrix in zip(found.panels, truth, strict=True):
        assert error_over_panel_px(panel.true_from_ideal, matrix, **SIZE).max() < 1e-6
    assert found.sigma_px < 1e-6


def test_a_careful_hand_recovers_a_tenth_of_a_pixel() -> None:
    errors = []
    for seed in range(12):
        truth = misaligned(STACK, reference=1, random=np.random.default_rng(seed))
        found = register(settings_of(truth, noise_px=0.06, seed=seed), STACK, reference=1)
        for panel, matrix in zip(found.panels, truth, strict=True):
            errors.append(np.sqrt((error_over_panel_px(panel.true_from_ideal, matrix, **SIZE) ** 2).mean()))
    assert np.mean(errors) < 0.06
    assert max(errors) < 0.1


def test_the_uncertainty_of_the_corners_is_what_repetition_shows() -> None:
    truth = misaligned(STACK, reference=1, random=np.random.default_rng(0))
    found = [register(settings_of(truth, noise_px=0.1, seed=seed), STACK, reference=1) for seed in range(40)]
    for index in (0, 2):
        corners = np.array([f.panels[index].corners_px for f in found])
        scatter = np.sqrt(((corners - corners.mean(0)) ** 2).sum(-1).mean())
        promised = np.mean([f.panels[index].setting_sigma_px for f in found])
        assert promised == pytest.approx(scatter, rel=0.15)


def test_a_viewpoint_off_the_mark_moves_panels_as_far_as_its_uncertainty_says() -> None:
    truth = [np.eye(3)] * 3
    moved = []
    for seed in range(40):
        off_m = np.random.default_rng(seed).normal(scale=0.002, size=3)
        found = register(settings_of(truth, off_m=off_m), STACK, reference=1)
        moved.append((found.panels[2].corners_px ** 2).sum(-1).mean())
    promised = register(settings_of(truth), STACK, reference=1).panels[2].viewpoint_sigma_px
    assert promised == pytest.approx(np.sqrt(np.mean(moved)), rel=0.25)
    assert promised > 0.5, "two millimetres at half a metre are more than half a pixel on a panel 6 cm away"


def test_verniers_between_outer_panels_count_too() -> None:
    truth = misaligned(STACK, reference=1, random=np.random.default_rng(2))
    first = settings_of(truth)
    across = simulate(
        [s for s in nominal(EYE, STACK, reference=0) if s.panel == 2], STACK, truth, noise_px=0.0,
        viewpoint_error_m=np.zeros(3), random=np.random.default_rng(0),
    )  # fmt: skip
    only_rear = [s for s in first if s.panel == 0]
    found = register([*only_rear, *across], STACK, reference=1)
    assert error_over_panel_px(found.panels[2].true_from_ideal, truth[2], **SIZE).max() < 1e-5


def test_two_panels_are_enough_of_a_stack() -> None:
    stack = PanelStack(0.5184, 0.2916, (0.0, 0.05), 1920, 1080)
    truth = misaligned(stack, reference=1, random=np.random.default_rng(0))
    found = register(settings_of(truth, stack=stack), stack, reference=1)
    assert error_over_panel_px(found.panels[0].true_from_ideal, truth[0], **SIZE).max() < 1e-6


def test_four_settings_a_panel_fit_exactly_and_promise_no_more_than_a_hand_can() -> None:
    truth = misaligned(STACK, reference=1, random=np.random.default_rng(1))
    everything = settings_of(truth)
    four = [[s for s in everything if s.panel == panel][number] for panel in (0, 2) for number in (0, 4, 10, 14)]
    found = register(four, STACK, reference=1)
    assert error_over_panel_px(found.panels[0].true_from_ideal, truth[0], **SIZE).max() < 1e-6
    assert found.panels[0].setting_sigma_px > 0.1


def test_too_few_settings_are_refused() -> None:
    three = [s for s in settings_of([np.eye(3)] * 3) if s.panel == 0][:3]
    with pytest.raises(ValueError, match="panel 0 has 3 settings"):
        register(three, STACK, reference=1)


def test_settings_on_a_line_are_refused() -> None:
    everything = settings_of([np.eye(3)] * 3)
    middle = {panel: np.median([s.reference_px[1] for s in everything if s.panel == panel]) for panel in (0, 2)}
    row = [s for s in everything if s.reference_px[1] == middle[s.panel]]
    assert len(row) == 10
    with pytest.raises(ValueError, match="on a line"):
        register(row, STACK, reference=1)


@pytest.mark.parametrize(
    ("matrix", "shift", "rotation", "scale"),
    [
        ([[1, 0, 2], [0, 1, -3], [0, 0, 1]], (2, -3), 0.0, (1, 1)),
        ([[1.01, 0, -9.6], [0, 1.01, -5.4], [0, 0, 1]], (0, 0), 0.0, (1.01, 1.01)),
    ],
)
def test_a_homography_in_words(
    matrix: list[list[float]], shift: tuple[int, int], rotation: float, scale: tuple[float, float]
) -> None:
    told = parts(np.array(matrix, dtype=float), **SIZE)
    np.testing.assert_allclose(told.shift_px, shift, atol=1e-9)
    np.testing.assert_allclose(told.scale, scale, atol=1e-12)
    assert told.rotation_deg == pytest.approx(rotation, abs=1e-12)
    assert told.keystone_px < 1e-9


def test_a_turn_and_a_keystone_in_words() -> None:
    angle = np.radians(0.3)
    about = np.array([[1, 0, 960], [0, 1, 540], [0, 0, 1]], dtype=float)
    turn = about @ np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    ) @ np.linalg.inv(about)  # fmt: skip
    assert parts(turn, **SIZE).rotation_deg == pytest.approx(0.3)
    assert parts(true_from_ideal(np.array([[2.0, 0], [-2, 0], [2, 0], [-2, 0]]), **SIZE), **SIZE).keystone_px == (
        pytest.approx(2.0, rel=0.01)
    )
