"""The reverse perspective uniform: plane-induced and brute force agree (EyeReal supplement, (40)-(47))."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given

from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from tests.optics import reference
from tests.optics.strategies import eyes, floats, stacks

IMAGE = {"width_px": 640, "height_px": 400, "fov_deg": 60.0}


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


def test_an_eye_in_a_panel_s_plane_is_refused_in_any_units() -> None:
    """Rounding error scales with the projection: a hundred thousand pixels, or a millionth of one."""
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
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="is not finite"):
        panel_from_image(projection, PanelStack(0.5, 0.3, (-0.06, 0.06), 64, 36).panel(0))


def test_an_image_whose_pixels_are_the_panels_own_needs_no_warp() -> None:
    raster = PlaneRaster(0.0, 0.0, 0.0, 1.0, 1.0, 16, 16)
    from_above = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    assert np.array_equal(panel_from_image(from_above, raster), np.eye(3))


def test_an_eye_a_picometre_before_a_panel_has_a_view() -> None:
    stack, random = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 1920, 1080), np.random.default_rng(2)
    for y_m, z_m in random.uniform(-1.0, 1.0, (50, 2)):
        panel_from_image(image_from_stack([0.06 + 1e-12, y_m, z_m], **IMAGE), stack.panel(2))
