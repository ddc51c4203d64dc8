"""The reference solver, one iteration at a time: the size of its step, its shares, its limits."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.model.job import Job
from runtime.model.sart import ITERATIONS, SartPredictor
from runtime.optics.malus import intensity_from_phase
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

INNER = (slice(8, 40), slice(16, 80))
PAIR = eyes(0.6)


def stack_of(count: int) -> PanelStack:
    return PanelStack(0.48, 0.24, tuple(np.linspace(-0.04, 0.04, count)), 96, 48)


def even(code: int) -> np.ndarray:
    """A picture of one grey."""
    picture = np.full((48, 96, 4), code, np.uint8)
    picture[..., 3] = 255
    return picture


def solved(count: int, left: int, right: int, *, iterations: int = ITERATIONS) -> np.ndarray:
    """(N, 3) codes in the panels' middle for eyes that want one grey each."""
    predictor = SartPredictor(stack_of(count), iterations=iterations)
    layers = predictor.solve(Job([[even(left)], [even(right)]], PAIR)).layers
    inner = layers[(slice(None), *INNER, slice(3))].reshape(count, -1, 3)
    assert (np.ptp(inner, axis=1) <= 1).all()
    return inner[:, 0]


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("code", [0, 37, 128, 255])
def test_one_iteration_is_a_whole_step_an_even_picture_is_solved_by_it(count: int, code: int) -> None:
    """Each eye's correction takes all that it lacks: half a step would leave a quarter of the way."""
    codes = solved(count, code, code, iterations=1)
    seen = intensity_from_phase(codes.sum(axis=0) / 255.0) * 255
    assert np.abs(seen - code).max() < 1 + 0.8 * count  # half a code a panel, at sin²'s steepest


@pytest.mark.parametrize("count", [2, 3, 4])
def test_what_an_eye_lacks_is_shared_by_all_panels_alike(count: int) -> None:
    codes = solved(count, 90, 90, iterations=1)
    assert (np.ptp(codes, axis=0) <= 1).all()


def test_the_right_eye_has_the_last_word_of_an_iteration() -> None:
    """Left, then right, each with what the panels show by then (Kaczmarz' order)."""
    codes = solved(3, 255, 0, iterations=1)
    assert codes.sum(axis=0) / 255.0 == pytest.approx([2.0] * 3, abs=0.01)


def test_the_sum_is_on_the_second_branch_from_black_two_panels_to_white_one() -> None:
    """Where sin² is flat an intensity says little: here the phases themselves are looked at."""
    for code, sum_ in ((0, 2.0), (128, 2 - 2 / np.pi * np.arcsin(np.sqrt(128 / 255))), (255, 1.0)):
        assert solved(3, code, code).sum(axis=0) / 255.0 == pytest.approx([sum_] * 3, abs=1.6 / 255)


def test_layers_are_rgba_of_8_bits_without_transparency() -> None:
    layers = SartPredictor(stack_of(3), iterations=1).solve(Job([[even(9)], [even(9)]], PAIR)).layers
    assert layers.dtype == np.uint8 and layers.shape == (3, 48, 96, 4)
    assert (layers[..., 3] == 255).all()


def test_panels_end_at_their_range_and_do_not_come_round() -> None:
    """A bar that is black for one eye and white for the other asks the outer panels for more than they have."""
    left, right = even(128), even(128)
    left[:, 40:56, :3], right[:, 40:56, :3] = 0, 255
    layers = SartPredictor(stack_of(3), iterations=60).solve(Job([[left], [right]], PAIR)).layers[..., :3].astype(int)
    assert layers.min() == 0
    assert np.abs(np.diff(layers, axis=2)).max() < 100, "a code that comes round jumps by the whole range"


def test_its_name_says_why_it_serves() -> None:
    assert SartPredictor(stack_of(3)).name == "sart"
    assert SartPredictor(stack_of(3), why="instead of fast").name == "sart (instead of fast)"
