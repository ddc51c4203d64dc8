"""Simulated retinas against a ray tracer in plain Python floats."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.optics.retina import ImageRays, average, pupil_points, seen_by
from runtime.optics.stack import PanelStack
from tests.optics import reference
from tests.optics.strategies import eyes, floats, stacks


def traced(
    eye: np.ndarray, layers: np.ndarray, stack: PanelStack, *, size: tuple[int, int], fov_deg: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
    """(h, w) intensity, mask and margin of a grey stack by the reference, one ray at a time."""
    grey = [layer.tolist() for layer in layers.astype(float)]
    rows = [
        [
            reference.traced_pixel(
                tuple(eye),
                grey,
                stack.x_m,
                u + 0.5,
                v + 0.5,
                width_m=stack.width_m,
                height_m=stack.height_m,
                image_size=size,
                fov_deg=fov_deg,
            )
            for u in range(size[0])
        ]
        for v in range(size[1])
    ]
    table = np.array(rows, dtype=float)
    return table[..., 0], table[..., 1].astype(bool), table[..., 2]


@settings(max_examples=40)
@given(eyes(), stacks(pixels=(16, 24)), st.integers(0, 2**31), floats(20.0, 110.0))
def test_what_an_eye_sees_is_what_its_rays_cross(eye: np.ndarray, stack: PanelStack, seed: int, fov: float) -> None:
    assume(math.hypot(eye[0], eye[1]) > 1e-3)
    rng = np.random.default_rng(seed)
    layers = rng.random((stack.count, stack.height_px, stack.width_px, 3), dtype=np.float32)
    seen = seen_by(eye, layers, stack, fov_deg=fov, width_px=21, height_px=13)
    for channel in range(3):
        image, mask, margin = traced(eye, layers[..., channel], stack, size=(21, 13), fov_deg=fov)
        # Within a hundredth of a pixel of the edge, or a ray all but parallel to the panels, float32 may differ.
        clear = margin > 1e-2
        np.testing.assert_array_equal(seen.mask[clear], mask[clear])
        np.testing.assert_allclose(seen.image[mask & clear][:, channel], image[mask & clear], atol=2e-4)


@given(st.integers(0, 2**31))
def test_code_values_are_fractions_of_255_and_alpha_is_ignored(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 32, 20)
    codes = rng.integers(0, 256, (3, 20, 32, 4), dtype=np.uint8)
    values = codes[..., :3].astype(np.float32) / np.float32(255)
    eye = [0.7, 0.05, 0.1]
    from_codes, from_values = seen_by(eye, codes, stack, fov_deg=40), seen_by(eye, values, stack, fov_deg=40)
    assert from_codes.image.shape == (20, 32, 3)
    np.testing.assert_allclose(from_codes.image, from_values.image, atol=2e-6)
    np.testing.assert_array_equal(from_codes.mask, from_values.mask)


@pytest.mark.parametrize("eye", [[0.06, 0, 0], [0.0, 0.3, 0], [-1, 0, 0], [math.nan, 0, 0], [math.inf, 0, 0]])
def test_an_eye_that_is_not_before_every_panel_is_refused(eye: list[float]) -> None:
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 32, 20)
    with pytest.raises(ValueError, match="in front of every panel"):
        seen_by(eye, np.zeros((3, 20, 32, 3), np.uint8), stack, fov_deg=40)


def test_rays_that_leave_the_panels_behind_do_not_count() -> None:
    # Nearly along the panels, half of a wide image looks away from them.
    eye = [0.05, 0.6, 0.0]
    mask = ImageRays.of_eye(eye, width_px=64, height_px=40, fov_deg=120).toward_panels()
    for u in range(0, 64, 7):
        for v in range(0, 40, 7):
            ray = reference.ray(tuple(eye), u + 0.5, v + 0.5, width=64, height=40, fov_deg=120)
            assert mask[v, u] == (ray[0] < 0)
    assert 0 < mask.mean() < 1


def test_rays_parallel_to_the_panels_are_masked_and_not_an_error() -> None:
    # At 45 degrees with 90 degrees of view, the top row's rays run exactly along the panels, straight up.
    stack = PanelStack(0.5, 0.5, (-0.01, 0.01), 8, 8)
    eye = [1.0, 0.0, -1.0]
    seen = seen_by(eye, np.full((2, 8, 8, 3), 128, np.uint8), stack, fov_deg=90, width_px=1, height_px=3)
    assert np.isfinite(seen.image[seen.mask]).all()


@given(floats(1e-3, 8e-3), st.integers(1, 6))
def test_pupil_points_cover_a_disc_evenly(diameter: float, rings: int) -> None:
    points = pupil_points(diameter, rings)
    radius = np.hypot(*points.T)
    assert len(points) == 1 + 3 * rings * (rings + 1)
    assert radius.max() < diameter / 2
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=1e-12)
    # The mean square radius of a full disc is half the radius squared.
    assert (radius**2).mean() == pytest.approx(diameter**2 / 8, rel=0.35 / rings)
    np.testing.assert_allclose(np.cov(points.T, bias=True), np.eye(2) * (radius**2).mean() / 2, atol=1e-12)


@given(st.integers(0, 2**31))
@settings(max_examples=10)
def test_a_finite_pupil_sees_the_mean_of_what_its_points_see(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stack = PanelStack(0.3, 0.2, (-0.03, 0.0, 0.03), 24, 16)
    layers = rng.random((3, 16, 24, 1), dtype=np.float32).repeat(3, axis=3)
    eye = np.array([0.5, 0.03, 0.06])
    right, up, _ = (np.array(axis) for axis in reference.eye_axes(tuple(eye)))
    positions = [eye + x * right + y * up for x, y in pupil_points(4e-3, 1)]
    views = [seen_by(p, layers, stack, fov_deg=20, width_px=9, height_px=7) for p in positions]
    by_hand = [traced(p, layers[..., 0], stack, size=(9, 7), fov_deg=20) for p in positions]
    together = np.all([mask for _, mask, _ in by_hand], axis=0)
    expected = np.mean([image for image, _, _ in by_hand], axis=0)
    np.testing.assert_allclose(average(v.image for v in views)[together][:, 0], expected[together], atol=2e-4)


def test_a_pupil_without_points_is_refused() -> None:
    with pytest.raises(ValueError, match="must have at least one point"):
        average([])
