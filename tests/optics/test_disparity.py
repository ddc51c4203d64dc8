"""Pairs with more disparity than a stack can show: planes of blocks at known depths, and what the warning says."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from runtime.optics.disparity import disparity_doubts
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64, U8

EYES = np.array([(0.6, -0.0315, 0.0), (0.6, 0.0315, 0.0)])
STACK = PanelStack(0.5184, 0.2916, (-0.01, 0.0, 0.01), 320, 180)


def blocks_at(x_m: float, eye_m: F64, *, seed: int = 4, width_px: int = 320) -> U8:
    """(h, w, 3) picture, 40 degrees wide, of a plane at x of random blocks, which look 3 cm wide."""
    width, height = width_px, width_px * 9 // 16
    image_from = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=40)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    gaze = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(image_from[:, :3]).T
    places = (eye_m + gaze * ((x_m - eye_m[0]) / gaze[..., :1]))[..., 1:] / (0.05 * (0.6 - x_m))
    column, row = np.moveaxis(np.floor(places).astype(int) % 64, -1, 0)
    return np.asarray(np.random.default_rng(seed).choice((30, 90, 160, 230), (64, 64, 3))[row, column], np.uint8)


def pair_at(x_m: float, *, eyes_m: F64 = EYES, width_px: int = 320) -> list[U8]:
    return [blocks_at(x_m, eye_m, width_px=width_px) for eye_m in eyes_m]


def doubts(
    pictures: Sequence[U8], *, stack: PanelStack = STACK, eyes_m: F64 = EYES, parallel: bool = True
) -> list[str]:
    return disparity_doubts(pictures, eyes_m, stack, fov_deg=40, parallel=parallel)


@pytest.mark.parametrize(
    ("panels_m", "x_m", "percent", "factor", "shift_px"),
    [
        ((-0.01, 0.0, 0.01), 0.1, 6, 2.6, 5),
        ((-0.01, 0.0, 0.01), -0.3, 10, 4.6, None),
        ((-0.02, 0.0, 0.02), 0.15, 7, 2.4, 8),
        ((0.01, 0.02, 0.04), 0.12, 5, 1.9, 5),
        ((-0.05, -0.03, -0.02), -0.2, 5, 1.9, None),
    ],
)
def test_a_plane_outside_the_stack_is_located_and_its_ghosts_estimated(
    panels_m: tuple[float, ...], x_m: float, percent: int, factor: float, shift_px: int | None
) -> None:
    stack = PanelStack(0.5184, 0.2916, panels_m, 320, 180)
    (told,) = doubts(pair_at(x_m), stack=stack)
    side = "in front of" if shift_px else "behind"
    found = re.search(rf"estimated at {percent}%.*is (\d+) mm {side} to (\d+) mm {side} the middle panel", told)
    assert found is not None, told
    for mm in found.groups():
        assert int(mm) == pytest.approx(1e3 * abs(x_m - panels_m[1]), rel=0.12)
    assert f"increase the gaps by a factor of {factor} or" in told
    assert (f"shift the left picture {shift_px} pixels left" in told) == ("rectified" in told) == bool(shift_px)
    assert "rectified" not in doubts(pair_at(x_m), stack=stack, parallel=False)[0]
    for by, ghosts in ((factor + 0.1, False), (factor / 1.2, True)):
        spread = replace(stack, x_m=tuple(panels_m[1] + by * (x - panels_m[1]) for x in panels_m))
        assert bool(doubts(pair_at(x_m), stack=spread)) == ghosts


def test_what_no_gaps_can_show_is_infinitely_far_behind() -> None:
    (told,) = doubts(pair_at(-1e6), stack=replace(STACK, x_m=(-1e-4, 0.0, 1e-4)))
    assert "is infinitely far behind to infinitely far behind the middle panel" in told and "factor" not in told


def test_codes_and_intensities_of_any_size_are_compared_alike() -> None:
    small, large = pair_at(0.1), pair_at(0.1, width_px=640)
    told = doubts(small)
    assert doubts([picture / np.float32(255) for picture in small]) == told
    assert doubts([np.dstack([picture, picture[..., 0]]) for picture in small]) == told
    assert "shift the left picture 9 pixels left" in doubts(large)[0]


@pytest.mark.parametrize(
    ("line", "is_compared"),
    [
        ((0.0, 1.0, 0.0), True),
        ((0.0, -1.0, 0.0), False),
        ((0.0, 1.0, 0.049), True),
        ((0.0, 1.0, 0.051), False),
        ((0.0, 1.0, -0.051), False),
        ((0.19, 1.0, 0.0), True),
        ((0.21, 1.0, 0.0), False),
        ((-0.21, 1.0, 0.0), False),
    ],
)
def test_only_eyes_side_by_side_are_compared(line: tuple[float, float, float], is_compared: bool) -> None:
    eyes_m = np.array([0.6, 0.0, 0.0]) + np.outer((-0.0315, 0.0315), line)
    assert bool(doubts(pair_at(0.1, eyes_m=eyes_m), eyes_m=eyes_m)) == is_compared


@pytest.mark.parametrize(
    ("beside", "rows", "ghosts"),
    [
        ("the middle panel", 0, False),
        ("the middle panel", 14, False),  # of 180
        ("the middle panel", 27, True),
        ("different scenes", 0, False),
        ("different scenes", 25, False),
        ("different scenes", 45, True),
        ("an even area", 40, False),
        ("an even area", 60, True),
    ],
)
def test_rows_outside_the_stack_are_reported_if_enough_match(beside: str, rows: int, ghosts: bool) -> None:
    rest = {
        "the middle panel": pair_at(0.0),
        "different scenes": [blocks_at(0.1, eye_m, seed=seed) for seed, eye_m in enumerate(EYES)],
        "an even area": [np.full((180, 320, 3), 90, np.uint8)] * 2,
    }[beside]
    assert (
        bool(doubts([np.concatenate([a[:rows], b[rows:]]) for a, b in zip(pair_at(0.2), rest, strict=True)])) == ghosts
    )


@pytest.mark.parametrize("period_px", [8, 12, 24])
@pytest.mark.parametrize("sharp", [False, True])
def test_a_texture_that_repeats_has_no_known_disparity(period_px: int, sharp: bool) -> None:
    def texture(shift_px: float) -> U8:
        down, across = np.mgrid[:180, :320] * (2 * np.pi / period_px)
        wave = np.sin(across + 2 * np.pi * shift_px / period_px) + np.sin(down)
        grey = 128 + 45 * (2 * np.sign(wave) if sharp else wave)
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)

    for shift_px in (0, 2, 6):
        assert doubts([texture(-shift_px / 2), texture(shift_px / 2)]) == []
