"""The reverse perspective uniform: closed form, plane-induced and brute force agree (EyeReal supplement, (40)-(47))."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from runtime.optics.rpu import corners_in_front, image_from_panel_four_points, panel_corners_px, panel_from_image
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from tests.optics import reference
from tests.optics.strategies import eyes, floats, stacks

IMAGE = {"width_px": 640, "height_px": 400, "fov_deg": 60.0}


def corners_seen(h: np.ndarray, stack: PanelStack) -> np.ndarray:
    weighted = np.column_stack([panel_corners_px(stack.panel(0)), np.ones(4)]) @ h.T
    return weighted[:, :2] / weighted[:, 2:]


def corner_error_px(h: np.ndarray, expected: np.ndarray, stack: PanelStack) -> float:
    return float(np.abs(corners_seen(h, stack) - expected).max())


@st.composite
def quadrilaterals(draw: st.DrawFn) -> np.ndarray:
    """Four corners in order, each within its own quadrant of a 1000 px image: convex and well apart."""
    jitter = np.array(draw(st.lists(floats(0.0, 240.0), min_size=8, max_size=8))).reshape(4, 2)
    return np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 1000.0], [0.0, 1000.0]]) + jitter * [
        [1, 1],
        [-1, 1],
        [-1, -1],
        [1, -1],
    ]


@given(quadrilaterals(), st.integers(16, 4000), st.integers(16, 4000))
def test_the_corrected_closed_form_is_opencvs_perspective_transform(
    corners: np.ndarray, width: int, height: int
) -> None:
    ours = image_from_panel_four_points(corners, width_px=width, height_px=height)
    panel = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    theirs = cv2.getPerspectiveTransform(panel, corners.astype(np.float32))
    probe = np.array([[[0.3 * width, 0.7 * height], [0.9 * width, 0.1 * height]]])
    np.testing.assert_allclose(
        cv2.perspectiveTransform(probe, ours), cv2.perspectiveTransform(probe, theirs), atol=1e-3
    )
    # Corners go to float32 on their way through OpenCV; ours are exact.
    np.testing.assert_allclose(cv2.perspectiveTransform(panel[None].astype(float), ours)[0], corners, atol=1e-9)


@given(eyes(), stacks())
def test_four_points_and_the_plane_induced_homography_agree(eye: np.ndarray, stack: PanelStack) -> None:
    raster = stack.panel(0)
    projection = image_from_stack(eye, **IMAGE)
    assume(corners_in_front(projection, raster))
    h = image_from_raster(projection, raster)
    corners = corners_seen(h, stack)
    # As a corner comes level with the eye it goes to infinity in the image, and four points say less and less.
    assume(np.abs(corners).max() < 1e5)
    closed = image_from_panel_four_points(corners, width_px=stack.width_px, height_px=stack.height_px)
    np.testing.assert_allclose(closed / np.linalg.norm(closed), h / np.linalg.norm(h) * np.sign(h[2, 2]), atol=1e-7)


@given(eyes(), stacks(), floats(0.05, 0.95), floats(0.05, 0.95))
def test_m_rpu_follows_the_ray_of_an_image_pixel_to_the_panel(
    eye: np.ndarray, stack: PanelStack, a: float, b: float
) -> None:
    assume(np.hypot(eye[0], eye[1]) > 1e-3)
    u, v = a * IMAGE["width_px"], b * IMAGE["height_px"]
    direction = reference.ray(tuple(eye), u, v, width=640, height=400, fov_deg=60.0)
    assume(direction[0] < -1e-2)
    for index in range(stack.count):
        hit = reference.hit_plane(tuple(eye), direction, stack.x_m[index])
        expected = reference.panel_pixel(
            hit, width_m=stack.width_m, height_m=stack.height_m, width=stack.width_px, height=stack.height_px
        )
        m = panel_from_image(image_from_stack(eye, **IMAGE), stack.panel(index))
        np.testing.assert_allclose(
            cv2.perspectiveTransform(np.array([[[u, v]]]), m)[0, 0], expected, rtol=1e-8, atol=1e-6
        )


@given(eyes(), stacks())
def test_m_rpu_is_the_inverse_of_the_homography(eye: np.ndarray, stack: PanelStack) -> None:
    projection = image_from_stack(eye, **IMAGE)
    h = image_from_raster(projection, stack.panel(0))
    m = panel_from_image(projection, stack.panel(0))
    assert np.abs(m).max() == pytest.approx(1.0)
    product = m @ h
    scale = np.trace(product) / 3
    bound = np.linalg.cond(h) * 1e-14
    np.testing.assert_allclose(product / scale, np.eye(3), atol=max(bound, 1e-9))


@given(quadrilaterals(), st.integers(0, 3), st.integers(0, 3), floats(-1.0, 2.0), floats(1e-12, 1e12))
def test_any_three_corners_on_a_line_or_two_at_one_place_are_refused(
    corners: np.ndarray, moved: int, steps: int, along: float, size: float
) -> None:
    """Seen in the issue: only the triangle of corners 1, 2 and 3 was looked at."""
    first, second = (moved + 1) % 4, (moved + 2 + steps % 2) % 4
    flat = corners.copy()
    flat[moved] = corners[first] + along * (corners[second] - corners[first])
    with pytest.raises(ValueError, match="collinear"):
        image_from_panel_four_points(flat * size, width_px=640, height_px=480)
    flat[moved] = corners[first]
    with pytest.raises(ValueError, match="collinear"):
        image_from_panel_four_points(flat * size, width_px=640, height_px=480)
    flat[moved] = np.inf
    with pytest.raises(ValueError, match="collinear"):
        image_from_panel_four_points(flat, width_px=640, height_px=480)
    image_from_panel_four_points(corners * size, width_px=640, height_px=480)


def test_an_eye_in_a_panels_plane_is_refused_in_any_units_of_the_image() -> None:
    """What is rounding error grows with the projection: a hundred thousand pixels, or a millionth of one."""
    stack, random = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 1920, 1080), np.random.default_rng(1)
    for size in (1e-6, 1.0, 1e5):
        for _ in range(50):
            y_m, z_m = random.uniform(-1.0, 1.0, 2)
            in_it, before_it = (
                np.diag([size, size, 1.0]) @ image_from_stack([x_m, y_m, z_m], **IMAGE) for x_m in (0.06, 0.061)
            )
            with pytest.raises(ValueError, match="panel's plane"):
                panel_from_image(in_it, stack.panel(2))
            panel_from_image(before_it, stack.panel(2))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_projection_that_is_not_finite_is_refused(value: float) -> None:
    projection = image_from_stack([0.6, 0.0, 0.0], **IMAGE)
    projection[0, 1] = value
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="singular"):
        panel_from_image(projection, PanelStack(0.5, 0.3, (-0.06, 0.06), 64, 36).panel(0))


def test_an_image_whose_pixels_are_the_panels_own_needs_no_warp() -> None:
    raster = PlaneRaster(0.0, 0.0, 0.0, 1.0, 1.0, 16, 16)
    from_above = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    assert np.array_equal(panel_from_image(from_above, raster), np.eye(3))


def test_a_corner_behind_the_eye_is_told() -> None:
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 1920, 1080)
    straight = image_from_stack([0.6, 0.0, 0.0], **IMAGE)
    # The gaze of this eye, 5 cm before the panel and far aside, leaves the near edge behind its image plane.
    aside = image_from_stack([0.065, 0.2, 0.0], **IMAGE)
    assert corners_in_front(straight, stack.panel(2))
    assert not corners_in_front(aside, stack.panel(2))
