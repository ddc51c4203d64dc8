"""Depth around an eye: a median that holes, noise and the wall behind do not move."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.eyes.eye_depth import depth_at, point_from_pixel
from tests.eyes.scene import camera

LIMITS = {"nearest_m": 0.2, "farthest_m": 4.0}


def at(depth: Any, point: tuple[float, float] = (32.0, 24.0), radius: float = 6.0, **more: Any) -> Any:
    return depth_at(depth, np.array(point), radius=radius, **LIMITS, **more)


@given(x=st.floats(-1, 1), y=st.floats(-0.6, 0.6), z=st.floats(0.2, 4))
def test_a_pixel_and_its_depth_give_back_the_point_that_was_projected(x: Any, y: Any, z: Any) -> None:
    view = camera()
    pixel = np.array([x / z * view.fx_px + view.cx_px, y / z * view.fy_px + view.cy_px])
    np.testing.assert_allclose(point_from_pixel(pixel, z, view), [x, y, z], atol=1e-12)


def test_the_middle_of_the_picture_is_straight_ahead() -> None:
    view = camera(640, 480)
    np.testing.assert_allclose(point_from_pixel(np.array([320.0, 240.0]), 0.5, view), [0, 0, 0.5], atol=1e-12)


def test_holes_are_bridged_by_a_larger_window() -> None:
    depth = np.full((48, 64), 800, np.uint16)
    depth[18:30, 26:38] = 0
    assert at(depth) == pytest.approx(0.8)


def test_nothing_measured_is_none_inside_and_outside_the_picture() -> None:
    assert at(np.zeros((48, 64), np.uint16)) is None
    assert at(np.full((48, 64), 800, np.uint16), point=(500.0, -300.0)) is None


def test_a_third_of_wall_or_of_outliers_does_not_pull() -> None:
    random = np.random.default_rng(0)
    depth = (700 + random.normal(0, 3, (48, 64))).astype(np.uint16)
    depth[random.random(depth.shape) < 0.3] = 2500
    assert at(depth) == pytest.approx(0.7, abs=0.002)


def test_what_is_not_at_the_faces_distance_does_not_count() -> None:
    depth = np.full((48, 64), 2500, np.uint16)
    depth[:, :30] = 700
    assert at(depth, expected_m=0.7) == pytest.approx(0.7)
