"""Tests that cards are sharpest at their depth when a finite pupil focuses on them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.retina import pupil_points
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.report import focal
from runtime.report.pairs import eyes_at

EYE = eyes_at(distance_m=focal.DISTANCE_M)[1]


def pixel(matrix: np.ndarray, point: np.ndarray) -> np.ndarray:
    weighted = matrix @ [*point, 1.0]
    return weighted[:2] / weighted[2]


@given(st.floats(0.2, 2.0), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.integers(0, 18))
def test_all_points_of_the_pupil_see_a_focused_point_alike(focus_m: float, right: float, up: float, index: int) -> None:
    pose = stack_from_eye(EYE)
    point = EYE - focus_m * pose[:3, 2] + right * pose[:3, 0] + up * pose[:3, 1]
    beside = focal.projection(EYE, pupil_points(focal.PUPIL_M)[index], focus_m=focus_m)
    middle = focal.projection(EYE, np.zeros(2), focus_m=focus_m)
    np.testing.assert_allclose(pixel(beside, point), pixel(middle, point), atol=1e-8)


def test_the_middle_of_the_pupil_is_the_pinhole_eye() -> None:
    plain = image_from_stack(EYE, width_px=focal.WIDTH_PX, height_px=focal.HEIGHT_PX, fov_deg=focal.FOV_DEG)
    np.testing.assert_allclose(focal.projection(EYE, np.zeros(2), focus_m=0.3), plain, atol=1e-9)


def test_out_of_focus_the_pupil_sees_a_disc_of_the_optical_size() -> None:
    """Blur = aperture·|1/f - 1/z|·focal length, from similar triangles."""
    pose = stack_from_eye(EYE)
    point = EYE - 0.5 * pose[:3, 2]
    edge = np.array([focal.PUPIL_M / 2, 0.0])
    spread = pixel(focal.projection(EYE, edge, focus_m=0.4), point) - pixel(
        focal.projection(EYE, -edge, focus_m=0.4), point
    )
    focal_px = focal.projection(EYE, np.zeros(2), focus_m=0.4)[:, :3] @ pose[:3, 0]
    expected = focal.PUPIL_M * (1 / 0.4 - 1 / 0.5) * focal_px[0]
    np.testing.assert_allclose(spread, [expected, 0.0], atol=1e-9)


@given(st.floats(0.3, 0.6), st.floats(1.0, 50.0))
def test_the_sharpest_distance_is_the_top_of_the_curve(top: float, steepness: float) -> None:
    distances = np.linspace(0.2, 0.7, 11)
    values = 10 - steepness * (distances - top) ** 2
    assert focal.sharpest(distances.tolist(), values.tolist()) == pytest.approx(top, abs=1e-6)


@pytest.fixture(scope="module")
def stack() -> focal.FocalStack:
    panels = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
    with focal.cards_painter(panels) as painter:
        return focal.focal_stack(painter, panels, model="fast")


def test_the_true_cards_are_sharpest_where_they_stand(stack: focal.FocalStack) -> None:
    for card in stack.cards:
        assert card.sharpest_true_m == pytest.approx(card.card_m, abs=0.008)


def test_through_the_layers_nearer_cards_are_sharpest_nearer(stack: focal.FocalStack) -> None:
    """Impossible on a flat panel: the depths in which the three cards are sharpest differ, in the right order."""
    behind, _, before = (card.sharpest_shown_m for card in stack.cards)
    assert behind > before
