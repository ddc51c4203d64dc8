"""Tests the solution meter: light as `light_db` measures it, lost detail, and changes between pictures."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from runtime.frame.meter import SolutionMeter, lost_detail, sampled_light
from runtime.model.geometry import TargetView
from runtime.model.job import Job, SolveWindow, Targets
from runtime.model.still import captured_views
from runtime.optics.light import LIGHT, squared_errors
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import Effort

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54)
TILTED = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54, Tilt(((0.0, 0.02, -0.01),) * 3, (0.5, 0.0, 0.0)))
EYES = np.array([[0.6, -0.031, 0.02], [0.6, 0.031, 0.02]])
FOV_DEG = 40.0


def smooth(*shape: int, seed: int) -> np.ndarray:
    """(n, h, w, 3) codes that change over some pixels."""
    coarse = np.random.default_rng(seed).integers(0, 256, (shape[0], 9, 16, 3), np.uint8)
    return np.stack([cv2.resize(one, (shape[2], shape[1]), interpolation=cv2.INTER_CUBIC) for one in coarse])


@pytest.mark.parametrize("stack", [STACK, TILTED], ids=["parallel", "tilted"])
def test_the_residual_is_the_error_of_the_light_at_pinhole_eyes(stack: PanelStack) -> None:
    layers, pictures = smooth(3, 54, 96, seed=1), smooth(2, 54, 96, seed=2)
    job = Job(Targets(stack, EYES, captured_views(list(pictures), EYES, stack, fov_deg=FOV_DEG)))
    places = np.random.default_rng(3).random((2, 16_000, 2))
    found = sampled_light(layers, job, places, boxes=True)
    targets = [picture.astype(np.float32) / 255 for picture in pictures]
    sampling = LIGHT._replace(pupil_mm=0.0, rays=4)
    expected = squared_errors(
        layers, targets, stack, solved_for_m=EYES, eyes_m=EYES, fov_deg=FOV_DEG, sampling=sampling
    )[0]
    assert found == pytest.approx(expected, rel=0.05)


def test_rays_cover_their_whole_pixel_and_no_more() -> None:
    """Of two pixels, one is clear and bright, and the other half clear and grey, on the middle panel alone."""
    layers, picture = np.full((3, 54, 96, 4), 255, np.uint8), np.full((27, 48, 3), 255, np.uint8)
    layers[1, :, 3::4, :3], picture[:, 1::2] = 0, 128
    plane_from_picture = np.linalg.inv(STACK.panel(1).raster_from_plane()) @ np.diag([2.0, 2.0, 1.0])
    for turned in (False, True):
        if turned:
            layers[1, ..., :3], picture[:] = 255, 255
            layers[1, 3::4, :, :3], picture[1::2] = 0, 128
        job = Job(Targets(STACK, EYES, (TargetView(picture, plane_from_picture),) * 2))
        assert sampled_light(layers, job, np.random.default_rng(3).random((2, 4_000, 2)), boxes=True) < 0.02


def test_a_coarse_solution_is_interpolated() -> None:
    """Otherwise, its pixels would be visible as squares."""
    layers, pictures = smooth(3, 54, 96, seed=1), smooth(2, 54, 96, seed=2)
    job = Job(Targets(STACK, EYES, captured_views(list(pictures), EYES, STACK, fov_deg=FOV_DEG)))
    places = np.random.default_rng(3).random((2, 4_000, 2))
    boxes, enlarged = (sampled_light(layers, job, places, boxes=boxes) for boxes in (True, False))
    assert boxes is not None and enlarged is not None and boxes != enlarged


def test_rays_that_miss_the_panels_have_no_error() -> None:
    away = np.array([[0.6, 5.0, 0.0], [0.6, 5.1, 0.0]])
    pictures = smooth(2, 54, 96, seed=2)
    job = Job(Targets(STACK, away, captured_views(list(pictures), EYES, STACK, fov_deg=FOV_DEG)))
    assert (
        sampled_light(smooth(3, 54, 96, seed=1), job, np.random.default_rng(3).random((2, 100, 2)), boxes=True) is None
    )


CARD_X_M = 0.4  # distance of a plane before the middle panel


def card(eyes_m: np.ndarray, *, first: tuple[int, int] = (0, 0), relief: float | None = None) -> Job:
    """A job for a smooth pattern on a plane before the panels, in the window from a pixel (right, down) on."""
    u, v = np.meshgrid(np.arange(first[0], 96) + 0.5, np.arange(first[1], 54) + 0.5)
    y, z = (u - 48) * 0.0054, (27 - v) * 0.0054
    views = []
    for x_m, y_m, z_m in eyes_m:
        share = (x_m - CARD_X_M) / x_m  # of the ray to the middle panel, from the eye to the card
        bright = np.sin(40 * (y_m + (y - y_m) * share)) * np.cos(50 * (z_m + (z - z_m) * share))
        codes = np.repeat(np.uint8(127.5 + 127.5 * bright)[..., None], 3, axis=2)
        views.append(TargetView(codes, np.eye(3)))
    box = PixelRect(*first, 96, 54)
    window = None if first == (0, 0) else SolveWindow(box, box, (4.0, 4.0))
    depth = None if relief is None else np.full((54, 96), relief, np.float32)
    return Job(Targets(STACK, eyes_m, tuple(views)), window=window, relief=depth)


def codes_job(*pictures: np.ndarray, stack: PanelStack = STACK, eyes_m: np.ndarray = EYES) -> Job:
    return Job(Targets(stack, eyes_m, tuple(TargetView(picture, np.eye(3)) for picture in pictures)))


def grey(code: int, height: int = 54, width: int = 96) -> np.ndarray:
    return np.full((height, width, 3), code, np.uint8)


BOX = PixelRect(0, 0, 96, 54)
LAYERS = np.zeros((3, 54, 96, 4), np.uint8)


def change_of(before: Job, after: Job, *, times_ns: tuple[int, int] = (0, 0)) -> tuple[float, float, float] | None:
    """What a new meter finds of two solutions, one after the other."""
    meter = SolutionMeter()
    first, second = (
        meter.measure(job, LAYERS, Effort(), time_ns=ns) for job, ns in zip((before, after), times_ns, strict=True)
    )
    assert first is not None and second is not None and first.change is None
    return second.change


@pytest.mark.parametrize("first", [(0, 0), (21, 13)], ids=["whole", "window"])
def test_pictures_are_compared_as_the_panels_show_them_to_moved_eyes(first: tuple[int, int]) -> None:
    """Eyes that coincide come nearer, so that all that they see was seen before."""
    for people in (1, 2):
        before_m = np.tile([1.2, 0.0, 0.02], (2 * people, 1))
        after_m = before_m + np.array([-0.6, 0.03, -0.02])
        known, unknown = (
            change_of(card(before_m, first=first, relief=each), card(after_m, first=first)) for each in (0.5, None)
        )
        assert known is not None and unknown is not None
        assert known[0] < 1e-4 and unknown[0] > 0.05
    after_m[:2] = before_m[:2]  # one of the two stays, and the panels follow nobody
    assert change_of(card(before_m, first=first, relief=0.5), card(after_m, first=first)) == pytest.approx(
        change_of(card(before_m, first=first), card(after_m, first=first))
    )


def test_a_change_has_the_pictures_difference_the_distance_and_the_time() -> None:
    pair, later = (
        codes_job(grey(0), grey(51)),
        codes_job(grey(51), grey(51), eyes_m=EYES + np.array([0.003, 0.004, 0.0])),
    )
    for times_ns in ((10**9, 25 * 10**8), (25 * 10**8, 10**9)):
        assert change_of(pair, later, times_ns=times_ns) == pytest.approx((0.04 / 2, 0.005, 1.5))


@pytest.mark.parametrize(
    "other",
    [
        codes_job(grey(0), grey(0), stack=replace(STACK, width_px=48)),
        codes_job(grey(0), grey(0), stack=replace(STACK, height_px=27)),
        codes_job(*[grey(0)] * 4, eyes_m=np.tile(EYES, (2, 1))),
        replace(
            codes_job(grey(0), grey(0)), window=SolveWindow(PixelRect(0, 0, 96, 54), PixelRect(0, 0, 0, 0), (1, 1))
        ),
    ],
    ids=["columns", "rows", "people", "window"],
)
def test_pictures_of_another_raster_or_of_other_people_are_not_compared(other: Job) -> None:
    assert change_of(codes_job(grey(0), grey(0)), other) is None


def test_each_effort_s_first_solution_and_every_fourth_are_measured() -> None:
    meter, job = SolutionMeter(), codes_job(grey(0), grey(51))
    efforts = [Effort(1, 2), Effort(2, 0), Effort(1, 2, continued_from=1), Effort(1, 3), *[Effort(1, 2)] * 3]
    found = [meter.measure(job, LAYERS, effort, time_ns=0) for effort in efforts]
    assert [each is not None and each.contrast is not None for each in found] == [
        True, True, False, True, False, False, True,
    ]  # fmt: skip
    assert [each is not None and each.change is not None for each in found] == [False, True, *[False] * 3, True, False]
    reductions = [set(each.detail) for each in found if each is not None]
    assert reductions == [{2, 3, 4}, set(), set(), {2, 3, 4}, set(), set(), {2, 3, 4}]


def test_contrast_is_half_the_variance_of_pictures_at_half_their_size() -> None:
    halves, checkers = grey(0), grey(0)
    halves[:, :48], checkers[::2, ::2], checkers[1::2, 1::2] = 255, 255, 255
    for picture, contrast in ((halves, 0.125 / 2), (checkers, 0.0)):
        measured = SolutionMeter().measure(codes_job(picture, grey(51)), LAYERS, Effort(), time_ns=0)
        assert measured is not None and measured.contrast == pytest.approx(contrast, abs=1e-9)


@pytest.mark.parametrize(
    ("rows", "lost"),
    [((0, 300), 0.25), ((100, 164), 0.125), ((200, 264), 0.125), ((0, 100), 0.0), ((164, 200), 0.0), ((264, 300), 0.0)],
)
def test_lost_detail_is_that_of_two_bands_of_the_picture(rows: tuple[int, int], lost: float) -> None:
    picture = np.zeros((300, 96, 4), np.uint8)
    picture[rows[0] : rows[1], ::2, :3] = 255  # every second column
    found = lost_detail(picture)
    assert found == pytest.approx({2: lost, 3: 1.11 * lost, 4: lost}, abs=2e-3)  # thirds of the columns differ


def test_pictures_too_small_to_reduce_have_no_detail_and_are_compared() -> None:
    assert lost_detail(grey(90, 3, 1)) == {2: 0.0, 3: 0.0, 4: 0.0}
    one, other = codes_job(grey(0, 1, 1), grey(0, 1, 1)), codes_job(grey(51, 1, 1), grey(51, 1, 1))
    assert change_of(one, other) == pytest.approx((0.04, 0.0, 0.0))
