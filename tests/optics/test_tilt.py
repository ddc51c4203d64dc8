"""An eye's view of panels that are not quite parallel, against individually traced rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.optics.focus import RetinaPixels
from runtime.optics.malus import phase_from_intensity
from runtime.optics.retina import Retina, seen_by
from runtime.optics.stack import PanelStack, Tilt
from runtime.optics.tilt import UNSEEN_PX, coarse_layer_from_seen, layer_from_seen

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)
PLACE = (0.5, 0.02, -0.01)
TILTED = replace(STACK, tilt=Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), PLACE))
EYES = ((0.5, 0.03, 0.0), (0.42, -0.1, 0.05), (0.7, 0.2, -0.1))


def traced(
    stack: PanelStack, index: int, eye_m: NDArray[np.float64], place_m: tuple[float | np.float32, float | np.float32]
) -> NDArray[np.float64]:
    """(2,) point of the layer that an eye sees at (y, z) of the ideal panel: two rays and a plane."""
    offset, right, up = stack.tilt.depth[index]
    normal, far = np.array([1.0, -right, -up]), stack.x_m[index] + offset
    ray = np.array([stack.x_m[index], *place_m]) - eye_m
    point = eye_m + ray * (far - normal @ eye_m) / (normal @ ray)
    origin = np.array(stack.tilt.seen_from_m)
    back = point - origin
    return (origin + back * (stack.x_m[index] - origin[0]) / back[0])[1:]


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("index", [0, 2])
def test_a_tilted_panel_is_where_two_rays_and_a_plane_put_it(eye: tuple[float, float, float], index: int) -> None:
    matrix = layer_from_seen(TILTED, index, np.array(eye))
    for place in ((0.0, 0.0), (0.2, 0.1), (-0.25, -0.14)):
        found = matrix @ [*place, 1.0]
        np.testing.assert_allclose(found[:2] / found[2], traced(TILTED, index, np.array(eye), place), atol=1e-12)


def test_from_the_place_of_registration_every_panel_looks_parallel() -> None:
    for index in range(3):
        np.testing.assert_allclose(layer_from_seen(TILTED, index, np.array(PLACE)), np.eye(3), atol=1e-12)


def test_a_panel_that_is_not_tilted_moves_for_nobody() -> None:
    assert np.array_equal(layer_from_seen(TILTED, 1, np.array(EYES[0])), np.eye(3))
    assert np.array_equal(layer_from_seen(STACK, 2, np.array(EYES[0])), np.eye(3))


@pytest.mark.parametrize("eye", EYES)
def test_what_is_simplified_stays_within_what_is_not_seen(eye: tuple[float, float, float]) -> None:
    u, v = np.meshgrid(np.linspace(-0.259, 0.259, 9), np.linspace(-0.145, 0.145, 9))
    places = np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)])
    for scale in (1e-3, 0.05, 1.0):
        depth = tuple((d * scale, r * scale, up * scale) for d, r, up in TILTED.tilt.depth)
        stack = replace(STACK, tilt=Tilt(depth, PLACE))
        exact, simple = (
            np.apply_along_axis(lambda row: row[:2] / row[2], 1, places @ of(stack, 2, np.array(eye)).T)
            for of in (layer_from_seen, coarse_layer_from_seen)
        )
        assert np.abs(exact - simple).max() < 1.5 * UNSEEN_PX * STACK.width_m / STACK.width_px


def test_a_tilt_that_nobody_sees_costs_nothing() -> None:
    hardly = replace(STACK, tilt=Tilt(((0.0, 1e-5, 1e-5),) * 3, PLACE))
    assert np.array_equal(coarse_layer_from_seen(hardly, 2, np.array(EYES[0])), np.eye(3))


def test_a_tilt_about_the_upright_alone_is_a_scale_and_a_shift() -> None:
    stack = replace(STACK, tilt=Tilt(((0.0, 0.01, 0.0),) * 3, (0.5, 0.0, 0.0)))
    matrix = coarse_layer_from_seen(stack, 2, np.array([0.5, 0.031, 0.0]))
    assert matrix[0, 0] != 1.0
    assert not matrix[[0, 1, 2, 2], [1, 0, 0, 1]].any()


@pytest.mark.parametrize(
    ("depth", "eye", "kinds"),
    [
        ((1.0, 0.0, 0.0), (0.5, 0.1, 0.0), {5.9e-5: "identity", 6.1e-5: "scale and shift"}),
        ((1.0, 0.0, 0.0), (0.6, 0.0, 0.0), {1.22e-4: "identity", 1.26e-4: "scale and shift"}),
        ((0.0, 0.0, 1.0), (0.5, 0.1, 0.0), {4.0e-4: "identity", 4.2e-4: "affine", 1e-2: "affine"}),
        ((0.0, 0.0, 1.0), (0.5, 0.0, 0.1), {4.0e-4: "identity", 4.2e-4: "scale and shift"}),
        ((0.0, 1.0, 0.0), (0.5, 0.031, 0.0), {1e-2: "scale and shift"}),
        ((0.0, 1.0, 0.0), (0.6, 0.0, 0.0), {4.6e-4: "identity", 7.0e-4: "scale and shift", 7.4e-4: "exact"}),
        ((0.0, 0.0, 1.0), (0.6, 0.0, 0.0), {8.4e-4: "identity", 8.8e-4: "exact"}),
    ],
)
@pytest.mark.parametrize("is_turned", [False, True])
def test_the_simplest_map_serves_that_errs_by_a_twentieth_of_a_pixel(
    depth: tuple[float, float, float], eye: tuple[float, float, float], kinds: dict[float, str], is_turned: bool
) -> None:
    """At the panel's corners and edges, by hand: 13.5 micrometres."""
    for size, kind in kinds.items():
        tilt = Tilt(tuple((depth[0] * size, depth[1] * size, depth[2] * size) for _ in range(3)), (0.5, 0.0, 0.0))
        stack, place = replace(STACK, tilt=tilt), np.array(eye)
        if is_turned:
            stack, place = stack.transposed(), place[[0, 2, 1]] * (1, -1, -1)
        matrix = coarse_layer_from_seen(stack, 2, place)
        sheared, bent = matrix[[0, 1], [1, 0]].any(), matrix[2, :2].any()
        found = "exact" if bent else "affine" if sheared else "scale and shift"
        assert kind == ("identity" if np.array_equal(matrix, np.eye(3)) else found), size


def test_a_stack_that_is_turned_tilts_the_other_way_about() -> None:
    eye, (y, z) = np.array([0.5, 0.03, 0.01]), (0.1, 0.02)
    turned_eye = np.array([eye[0], -eye[2], -eye[1]])
    whole = layer_from_seen(TILTED, 2, eye) @ [y, z, 1.0]
    found = layer_from_seen(TILTED.transposed(), 2, turned_eye) @ [-z, -y, 1.0]
    np.testing.assert_allclose(found[:2] / found[2], [-whole[1] / whole[2], -whole[0] / whole[2]], atol=1e-12)


LOOKS: dict[str, Callable[[NDArray[np.float32], PanelStack, NDArray[np.float64]], Retina]] = {
    "pinhole": lambda layers, stack, eye: seen_by(eye, layers, stack, fov_deg=40.0, width_px=192, height_px=108),
    "pupil": lambda layers, stack, eye: RetinaPixels(stack.panel(1)).seen(layers, stack, eye, plane_m=0.01),
}


@pytest.mark.parametrize("look", LOOKS)
def test_a_simulated_retina_looks_through_tilted_panels(look: str) -> None:
    small = replace(TILTED, width_px=192, height_px=108)
    eye = np.array([0.5, -0.1, 0.02])
    ramps = np.zeros((3, 108, 192, 3), np.float32)
    ramps[2, ..., 0], ramps[2, ..., 1] = (np.arange(192) + 0.5) / 192, ((np.arange(108) + 0.5) / 108)[:, None]
    seen, ideal = (LOOKS[look](ramps, stack, eye).image[30, 50, :2] for stack in (small, replace(small, tilt=None)))
    (u, v), (ideal_u, ideal_v) = (phase_from_intensity(each, 1) * [192, 108] for each in (seen, ideal))
    pitch = small.width_m / small.width_px
    y, z = traced(small, 2, eye, (ideal_u * pitch - small.width_m / 2, small.height_m / 2 - ideal_v * pitch))
    assert u == pytest.approx((y + small.width_m / 2) / pitch, abs=1e-3)
    assert v == pytest.approx((small.height_m / 2 - z) / pitch, abs=1e-3)
    assert abs(u - ideal_u) > 0.01, "this test must be able to fail"
