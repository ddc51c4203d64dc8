"""Differing regions of two eyes' pictures, and the window around them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from runtime.model.geometry import TargetView
from runtime.model.job import Job, Savings, SolveWindow, Targets, drawn_job, drawn_views
from runtime.model.trim import (
    coarse_box,
    differing_box,
    differing_window,
    extent_window,
    parallax_margin_px,
    steepness,
    steepness_beside,
    still_fits,
    taper_parallaxes,
    taper_px,
    trim,
    whole_rays,
    window_around,
)
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.support.gl import DrawnPicture

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
    for first, last in ((box.u0, box.u0 + 1), (box.u1 - 1, box.u1)):
        assert differing_box(left, right, known=PixelRect(first, box.v0, last, box.v1)) == box


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
    for side in (slice(0, 80), slice(120, 200)):
        grey = picture.copy()
        grey[20:60, side, :3] = 127
        assert steepness_beside(grey, box) > 0.9
    assert steepness(np.array([0, 51], np.uint8)) == pytest.approx(0.32**0.5)  # 2·sqrt(0.2·0.8), and nothing
    assert steepness(np.zeros((0, 3), np.uint8)) == 0.0
    assert [taper_parallaxes(steep) for steep in (0.0, 0.5, 1.0)] == [6.0, 10.0, 14.0]


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


# Pixels of 1 mm and gaps of 10 mm: an eye's ray crosses the front panel at 0.98·u + shift, from the panel's centre, and
# the rear one at 1.02·u - shift. The shifts are 1 pixel, left and right, and half a pixel up.
THIN = PanelStack(0.8, 0.4, (-0.01, 0.0, 0.01), 800, 400)
NEAR = np.array([[0.5, -0.05, 0.025], [0.5, 0.05, 0.025]])


@pytest.mark.parametrize(
    ("box", "held"),
    [
        ((300, 180, 340, 210), (243, 155, 395, 235)),
        ((0, 0, 40, 30), (0, 0, 104, 80)),
        ((760, 370, 800, 400), (696, 320, 800, 400)),
        ((0, 180, 800, 210), (0, 155, 800, 235)),
        ((300, 0, 340, 400), (243, 0, 395, 400)),
    ],
)
def test_a_window_is_a_box_with_its_crossings_taper_and_margin(box: tuple[int, ...], held: tuple[int, ...]) -> None:
    """First box: left 2 x 3 of crossings, 20 of tapers and 16 of margin, which makes sixteenths of the panel."""
    found = window_around(PixelRect(*box), NEAR, THIN, parallaxes=10.0)
    assert found is not None and found.corners == held


@pytest.mark.parametrize(
    ("box", "inner"),
    [
        ((200, 100, 400, 250), (207, 104, 396, 246)),
        ((0, 100, 400, 400), (0, 104, 396, 400)),
        ((400, 0, 800, 250), (404, 0, 800, 246)),
        ((200, 100, 208, 107), (207, 104, 207, 104)),  # none
    ],
)
def test_whole_rays_stay_two_pixels_inside_a_window_on_every_panel(
    box: tuple[int, ...], inner: tuple[int, ...]
) -> None:
    assert whole_rays(PixelRect(*box), NEAR, THIN).corners == inner


def test_tapers_are_as_wide_as_the_eyes_parallaxes() -> None:
    rolled = NEAR + np.array([[0.0, 0.0, -0.01], [0.0, 0.0, 0.01]])
    assert taper_px(NEAR, THIN, parallaxes=10.0) == pytest.approx((20.0, 0.0))
    assert taper_px(rolled, THIN, parallaxes=10.0) == pytest.approx((20.0, 4.0))
    assert parallax_margin_px(rolled, THIN)[1, 2] == pytest.approx([1.0, -0.7])


@pytest.mark.parametrize(
    ("held", "fits"),
    [
        ((100, 100, 230, 200), True),
        ((100, 100, 231, 200), False),
        ((101, 100, 210, 200), False),
        ((100, 101, 200, 210), False),
        ((90, 100, 199, 200), False),
        ((100, 90, 200, 199), False),
    ],
)
def test_a_window_is_kept_if_it_holds_the_new_one_tightly(held: tuple[int, ...], fits: bool) -> None:
    assert still_fits(PixelRect(*held), PixelRect(100, 100, 200, 200)) == fits


def test_a_quick_comparison_sees_every_sixteenth_pixel() -> None:
    left = np.full((100, 160, 4), 100, np.uint8)
    right = left.copy()
    right[17:48, 33:64] = 50  # samples at row 32 and column 48
    assert coarse_box(left, right) == PixelRect(48, 32, 49, 33)
    right[16, 80] = 50
    assert coarse_box(left, right) == PixelRect(48, 16, 81, 33)


def test_the_window_of_known_content_depends_on_its_background() -> None:
    extent = PixelRect(300, 180, 380, 210)
    black, mixed = (extent_window(extent, colour, NEAR, THIN) for colour in ((0, 0, 0), (0, 51, 255)))
    assert black is not None and mixed is not None
    assert black.taper_px == pytest.approx((12.0, 0.0)) and mixed.taper_px == pytest.approx((24.8, 0.0))
    assert (black.colour, mixed.colour) == ((0, 0, 0), (0, 51, 255))
    assert black.box.corners == (262, 155, 414, 235) and black.kept.corners == (268, 158, 410, 231)
    assert mixed.box.corners == (238, 155, 438, 235)
    assert extent_window(extent, (0, 0, 0), NEAR, THIN, mixed) == black  # the old one is too large
    slightly = replace(black, box=PixelRect(260, 155, 416, 240))
    kept = extent_window(extent, (0, 0, 0), NEAR, THIN, slightly)
    assert kept is not None and kept.box == slightly.box and kept.kept.corners == (266, 158, 412, 236)
    assert extent_window(PixelRect(300, 180, 300, 210), (0,), NEAR, THIN) is None
    assert extent_window(PixelRect(0, 0, 800, 400), (0,), NEAR, THIN, black) is None


def pair(right_codes: int = 100) -> list[np.ndarray]:
    """Pictures for the panels: grey, but for coloured columns on the left; they differ in the middle."""
    left = np.full((400, 800, 4), 100, np.uint8)
    left[:, :8, 0] = 200
    right = left.copy()
    right[180:210, 300:340, :3] = right_codes
    return [left, right]


def test_a_job_is_trimmed_to_where_its_pictures_differ() -> None:
    whole = drawn_job(pair(120), NEAR, THIN)
    job = trim(whole)
    assert job.window is not None and job.window.colour is None
    assert job.window.box.corners == (243, 155, 395, 235)
    assert job.channels == 1  # the colour is outside the window
    assert job.savings == Savings(152 * 80 / 320_000, 1) and whole.savings == Savings(1.0, 3)
    assert trim(replace(whole, window=job.window)).window is job.window
    wide = SolveWindow(PixelRect(0, 155, 800, 235), PixelRect(0, 155, 800, 235), (1.0, 1.0))
    assert trim(replace(whole, window=wide)).channels == 3
    assert trim(whole, wide) == job


def test_equal_pictures_need_no_steps_and_textures_are_not_compared() -> None:
    job = trim(drawn_job(pair(), NEAR, THIN))
    assert job.window == SolveWindow(PixelRect(0, 0, 0, 0), PixelRect(0, 0, 0, 0), (0.0, 0.0))
    assert (job.channels, job.savings.solved_share) == (3, 0.0)
    for flags, channels in (((True, True), 1), ((True, False), 3)):
        textures = [DrawnPicture(None, None, pair()[0], grey) for grey in flags]  # type: ignore[arg-type]
        drawn = trim(drawn_job(textures, NEAR, THIN))
        assert (drawn.window, drawn.channels) == (None, channels)


def test_a_third_view_widens_the_window() -> None:
    left, right = pair(120)
    third = left.copy()
    third[180:210, 440:480, :3] = 120
    eyes_m = np.concatenate([NEAR, NEAR[:1]])
    window = differing_window(Job(Targets(THIN, eyes_m, drawn_views([left, right, third], THIN))))
    assert window is not None and window.box.u0 < 260 and window.box.u1 > 520
