"""Eye poses, projections and the ways between parallel planes, against brute-force rays."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from runtime.optics.stack import PanelStack, Plane
from runtime.optics.views import (
    image_from_camera,
    image_from_raster,
    image_from_stack,
    raster_from_stack,
    stack_from_eye,
)
from tests.optics import reference
from tests.optics.strategies import eyes, floats, stacks


@given(eyes(nearest_m=1e-6, farthest_m=1e6, off_axis_deg=180.0))
def test_a_pose_is_an_upright_rotation_that_looks_at_the_origin(eye: np.ndarray) -> None:
    pose = stack_from_eye(eye)
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_array_equal(pose[:3, 3], eye)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    np.testing.assert_allclose(np.cross(rotation[:, 2], eye / np.abs(eye).max()), 0, atol=1e-15)
    assert rotation[:, 2] @ eye > 0, "z points from the scene towards the eye"
    assert rotation[2, 0] == 0.0, "x is parallel to the ground"
    assert rotation[2, 1] >= 0.0, "y is up"


@given(eyes(off_axis_deg=89.0))
def test_a_pose_has_the_axes_of_a_hand_made_one(eye: np.ndarray) -> None:
    assume(math.hypot(eye[0], eye[1]) > 1e-6)
    right, up, gaze = reference.eye_axes(tuple(eye))
    np.testing.assert_allclose(stack_from_eye(eye)[:3, :3], np.column_stack([right, up, -np.array(gaze)]), atol=1e-9)


@pytest.mark.parametrize("height", [1.0, -1.0, 1e-9, 1e9, 5e-324])
def test_on_the_vertical_axis_the_limit_from_the_front_is_taken(height: float) -> None:
    pose = stack_from_eye([0.0, 0.0, height])
    np.testing.assert_array_equal(pose[:3, 0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(pose[:3, 2], [0.0, 0.0, math.copysign(1.0, height)])
    np.testing.assert_allclose(
        pose[:3, :3], stack_from_eye([1e-12 * height if height > 0 else 1e-30, 0.0, height])[:3, :3], atol=2e-12
    )


@given(st.sampled_from([5e-324, 1e-310, 1e-300, 1e-200, 1e-100, 1e-12]), floats(-math.pi, math.pi), floats(0.1, 1e3))
def test_beside_the_vertical_axis_the_head_turns_towards_it(off_m: float, turn: float, height: float) -> None:
    eye = np.array([off_m * math.cos(turn), off_m * math.sin(turn), height])
    assume(eye[0] != 0.0 or eye[1] != 0.0)
    rotation = stack_from_eye(eye)[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-15)
    assert rotation[:2, 0] @ (eye[:2] / np.abs(eye[:2]).max()) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("eye", [[0, 0, 0], [math.nan, 0, 1], [math.inf, 0, 0], [1, 2, -math.inf]])
def test_an_eye_without_a_direction_is_refused(eye: list[float]) -> None:
    with pytest.raises(ValueError, match="no direction of gaze"):
        stack_from_eye(eye)


@pytest.mark.parametrize("scale", [5e-324, 1e-200, 1e200, 1.7e308])
def test_the_pose_does_not_depend_on_the_unit_of_length(scale: float) -> None:
    np.testing.assert_allclose(
        stack_from_eye([scale, 0.0, scale])[:3, :3], stack_from_eye([1.0, 0.0, 1.0])[:3, :3], atol=1e-15
    )


@given(floats(1.0, 170.0), st.integers(1, 8000), st.integers(1, 8000))
def test_the_field_of_view_is_horizontal_and_the_pixels_are_square(fov: float, width: int, height: int) -> None:
    camera = image_from_camera(width_px=width, height_px=height, fov_deg=fov)
    edge = camera @ [math.tan(math.radians(fov / 2)), 0.0, 1.0]
    np.testing.assert_allclose(edge[:2], [width, height / 2], rtol=1e-12)
    assert camera[0, 0] == camera[1, 1]


@given(eyes(off_axis_deg=89.0), floats(-0.5, 0.05), floats(-1, 1), floats(-1, 1), floats(20.0, 100.0))
def test_projection_agrees_with_opencv(eye: np.ndarray, x: float, y: float, z: float, fov: float) -> None:
    assume(math.hypot(eye[0], eye[1]) > 1e-3)
    point = np.array([x, y, z])
    right, up, gaze = (np.array(axis) for axis in reference.eye_axes(tuple(eye)))
    depth = float(gaze @ (point - eye))
    assume(depth > 0.02)
    # OpenCV's camera: x right, y down, z along the gaze.
    camera_from_stack = np.stack([right, -up, gaze])
    focal = 320 / math.tan(math.radians(fov / 2))
    expected, _ = cv2.projectPoints(
        point.reshape(1, 3),
        cv2.Rodrigues(camera_from_stack)[0],
        -camera_from_stack @ eye,
        np.array([[focal, 0, 320], [0, focal, 200], [0, 0, 1]]),
        None,
    )
    seen = image_from_stack(eye, width_px=640, height_px=400, fov_deg=fov) @ [*point, 1.0]
    assert seen[2] == pytest.approx(depth, rel=1e-9)
    np.testing.assert_allclose(seen[:2] / seen[2], expected.ravel(), rtol=1e-6, atol=1e-4)


@given(eyes(), stacks(), floats(0.0, 1.0), floats(0.0, 1.0), floats(-0.2, 0.05))
def test_a_rasters_projection_follows_the_ray_from_the_eye(
    eye: np.ndarray, stack: PanelStack, a: float, b: float, x: float
) -> None:
    assume(abs(eye[0] - x) > 1e-3)
    raster = stack.panel(0)
    point = (x, (a - 0.5) * 0.6, (b - 0.5) * 0.6)
    hit = reference.hit_plane(tuple(eye), reference.subtract(point, tuple(eye)), raster.x_m)
    u, v = reference.panel_pixel(
        hit, width_m=stack.width_m, height_m=stack.height_m, width=stack.width_px, height=stack.height_px
    )
    seen = raster_from_stack(eye, raster) @ [*point, 1.0]
    assert seen[2] == pytest.approx(eye[0] - x, abs=1e-12)
    np.testing.assert_allclose(seen[:2] / seen[2], [u, v], rtol=1e-9, atol=1e-7)


@given(eyes(), stacks(), floats(0.0, 1.0), floats(0.0, 1.0))
def test_the_plane_induced_homography_is_the_projection_of_the_pixels_place(
    eye: np.ndarray, stack: PanelStack, a: float, b: float
) -> None:
    raster = stack.panel(stack.count - 1)
    projection = image_from_stack(eye, width_px=640, height_px=400, fov_deg=40)
    u, v = a * stack.width_px, b * stack.height_px
    place = [raster.x_m, (u / stack.width_px - 0.5) * stack.width_m, (0.5 - v / stack.height_px) * stack.height_m, 1.0]
    np.testing.assert_allclose(
        image_from_raster(projection, raster) @ [u, v, 1.0], projection @ place, rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(raster.stack_from_raster() @ [u, v, 1.0], place[:3], atol=1e-12)
    np.testing.assert_allclose(raster.raster_from_plane() @ raster.plane_from_raster(), np.eye(3), atol=1e-12)


def test_eyes_in_single_precision_or_whole_metres_are_taken_as_doubles() -> None:
    raster = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 64, 36).panel(0)
    for eye in (np.array([0.61, 0.13, -0.07], np.float32), np.array([2, 1, 0])):
        double = eye.astype(np.float64)
        assert np.array_equal(stack_from_eye(eye), stack_from_eye(double))
        assert np.array_equal(raster_from_stack(eye, raster), raster_from_stack(double, raster))
        for one, other in zip(*(Plane(0.01).scale_shift_to(Plane(-0.06), at) for at in (eye, double)), strict=True):
            assert np.array_equal(one, other) and one.dtype == np.float64
