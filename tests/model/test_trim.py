"""Differing regions of two eyes' pictures, and the window around them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from runtime.model.geometry import TargetView
from runtime.model.job import Job, Targets
from runtime.model.trim import (
    coarse_box,
    differing_box,
    differing_window,
    parallax_margin_px,
    steepness,
    steepness_beside,
    still_fits,
    taper_parallaxes,
    whole_rays,
    window_around,
)
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
EYES = np.array([[0.6, -0.03, 0.05], [0.6, 0.03, 0.05]])


@given(st.integers(0, 90), st.integers(0, 150), st.integers(1, 10), st.integers(1, 10), st.integers(3, 155))
@settings(max_examples=50, deadline=None)
def test_the_box_is_exactly_where_they_differ(v: int, u: int, height: int, width: int, step: int) -> None:
    left = np.full((100, 160, 4), 100, np.uint8)
    right = left.copy()
    right[v : v + height, u : u + width, 1] = (100 + step) % 256
    box = differing_box(left, right)
    assert box == PixelRect(u, v, min(u + width, 160), min(v + height, 100))


def test_a_picture_that_differs_everywhere_is_whole() -> None:
    random = np.random.default_rng(0)
    left, right = random.integers(0, 256, (2, 270, 480, 4), np.uint8)
    assert differing_box(left, right) == PixelRect(0, 0, 480, 270)


def test_a_coarse_look_never_finds_more_than_a_close_one() -> None:
    random, found = np.random.default_rng(1), 0
    for _ in range(20):
        left = np.full((270, 480, 4), 100, np.uint8)
        right = left.copy()
        u, v = random.integers(0, 400), random.integers(0, 200)
        right[v : v + random.integers(1, 70), u : u + random.integers(1, 80), 0] = 50
        coarse, close = coarse_box(left, right), differing_box(left, right)
        if coarse.width_px and coarse.height_px:
            found += 1
            assert close.u0 <= coarse.u0 and close.v0 <= coarse.v0
            assert coarse.u1 <= close.u1 and coarse.v1 <= close.v1
            assert close.width_px - coarse.width_px <= 32
            assert differing_box(left, right, known=coarse) == close
    assert found >= 10


def test_the_margin_is_the_parallax_of_the_outer_panels() -> None:
    margin = parallax_margin_px(EYES, STACK)
    per_metre = STACK.width_px / STACK.width_m
    assert margin[0, 2] == pytest.approx(np.array([-0.03 * 0.1, -0.05 * 0.1]) * per_metre)
    assert margin[0, 1] == pytest.approx([0.0, 0.0])


@given(st.floats(0.3, 1.5), st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), st.integers(100, 800), st.integers(100, 400))
@settings(max_examples=100, deadline=None)
def test_a_window_holds_the_difference_and_its_room_or_is_whole(x: float, y: float, z: float, u: int, v: int) -> None:
    eyes = np.array([[x, y - 0.03, z], [x, y + 0.03, z]])
    box = PixelRect(u, v, u + 30, v + 20)
    held = window_around(box, eyes, STACK, parallaxes=14.0)
    assume(held is not None)
    inner = whole_rays(held, eyes, STACK)
    assert held.u0 <= inner.u0 <= u and held.u1 >= inner.u1 >= u + 30
    assert held.v0 <= inner.v0 <= v and held.v1 >= inner.v1 >= v + 20
    assert still_fits(held, held)


def test_windows_have_few_sizes() -> None:
    sizes = set()
    for width in range(5, 200, 3):
        window = window_around(PixelRect(400, 200, 400 + width, 240), EYES, STACK, parallaxes=14.0)
        assert window is not None
        sizes.add(window.width_px)
    assert len(sizes) <= 5


def test_a_phase_s_error_shows_most_before_mid_grey() -> None:
    assert steepness(np.array([0, 255], np.uint8)) == 0.0
    assert steepness(np.array([127], np.uint8)) == pytest.approx(1.0, abs=0.01)
    picture = np.full((100, 200, 4), 255, np.uint8)
    box = PixelRect(80, 20, 120, 60)
    picture[20:60, 80:120] = 127  # within the box nothing fades
    assert steepness_beside(picture, box) == 0.0
    picture[70:, :80] = 127  # neither in other rows
    assert steepness_beside(picture, box) == 0.0
    picture[20:60, :80, :3] = 127
    assert steepness_beside(picture, box) > 0.9


def test_before_white_a_window_is_smaller_than_before_grey() -> None:
    box = PixelRect(400, 200, 440, 240)
    white, grey = (window_around(box, EYES, STACK, parallaxes=taper_parallaxes(steep)) for steep in (0.0, 1.0))
    assert white is not None and grey is not None
    assert white.width_px < 0.7 * grey.width_px
    assert still_fits(grey, white) == (grey.width_px <= 1.3 * white.width_px)
    assert not still_fits(white, grey)


def on_plane(picture: np.ndarray, stack: PanelStack) -> TargetView:
    """A picture that covers the middle panel, whatever its number of pixels."""
    height, width = picture.shape[:2]
    raster = replace(stack, width_px=width, height_px=height).panel(1)
    return TargetView(picture, raster.plane_from_raster())


@pytest.mark.parametrize("aside_m", [-0.15, 0.0, 0.15])
@pytest.mark.parametrize("times", [2, 3])
def test_photographs_have_the_window_of_the_same_pictures_drawn(aside_m: float, times: int) -> None:
    """Photographs have their own pixels, and are compared on a coarse raster over what the eyes see."""
    eyes_m = EYES + np.array([0.0, aside_m, 0.0])
    box = PixelRect(420, 240, 480, 300)
    left = np.full((540, 960, 3), 100, np.uint8)
    right = left.copy()
    right[box.slices] = 200
    drawn, taken = (
        differing_window(Job(Targets(STACK, eyes_m, (on_plane(pair[0], STACK), on_plane(pair[1], STACK)))))
        for pair in ((left, right), [np.repeat(np.repeat(p, times, axis=0), times, axis=1) for p in (left, right)])
    )
    assert drawn is not None and taken is not None
    assert np.abs(np.array(drawn.box.corners) - taken.box.corners).max() <= 8
    assert taken.box.u0 < box.u0 and taken.box.v0 < box.v0 and taken.box.u1 > box.u1 and taken.box.v1 > box.v1


@pytest.mark.parametrize(("codes", "differs"), [(2, False), (3, True)])
def test_differences_of_up_to_two_codes_are_ignored(codes: int, differs: bool) -> None:
    left = np.full((100, 160, 4), 100, np.uint8)
    right = left.copy()
    right[40:50, 60:70] += np.uint8(codes)
    right[..., 3] = 0  # coverage is not light
    assert bool(differing_box(left, right).width_px) == differs


@pytest.mark.parametrize(("share", "whole"), [(0.45, False), (0.5, True)])  # with margins 0.57 and 0.61
def test_a_window_of_over_six_tenths_of_the_panel_is_the_whole(share: float, whole: bool) -> None:
    side = np.sqrt(share)
    box = PixelRect(round(480 - 480 * side), round(270 - 270 * side), round(480 + 480 * side), round(270 + 270 * side))
    far = np.array([[1e6, -0.03, 0.0], [1e6, 0.03, 0.0]])  # without parallax, the window is the box and its margin
    found = window_around(box, far, replace(STACK, width_px=960), parallaxes=0.0)
    assert (found is None) == whole
