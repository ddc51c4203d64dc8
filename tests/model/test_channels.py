"""Grey pictures in one channel: told by every pixel, and solved to the same layers."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from runtime.config import ModelSettings
from runtime.model.job import Savings, drawn_job
from runtime.model.predictor import load_predictor
from runtime.model.targets import is_grey
from runtime.model.trim import trim
from runtime.optics.stack import PanelStack
from runtime.records import U8

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
EYES = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])


def grey_pictures(seed: int = 0) -> list[U8]:
    random = np.random.default_rng(seed)
    pictures = []
    for _ in range(2):
        one = cv2.GaussianBlur(random.integers(0, 256, (270, 480), np.uint8), (0, 0), 3)
        stretched = np.clip((one.astype(np.float64) - 127) * 8 + 127, 0, 255).astype(np.uint8)
        pictures.append(np.asarray(cv2.cvtColor(stretched, cv2.COLOR_GRAY2RGBA), np.uint8))
    return pictures


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_one_pixel_of_colour_is_colour(channel: int) -> None:
    picture = grey_pictures()[0]
    assert is_grey(picture)
    picture[101, 203, channel] ^= 1
    assert not is_grey(picture)


@pytest.mark.parametrize("name", ["fast", "balanced", "best"])
def test_one_channel_gives_the_layers_of_three(name: str) -> None:
    """To a few last digits: OpenCV rounds a sixteenth of a code differently where it resizes three channels."""
    predictor = load_predictor(name, STACK, ModelSettings(name=name))
    job = drawn_job(grey_pictures(), EYES, STACK)
    three = predictor.solve(job).layers.copy()
    trimmed = trim(job)
    assert trimmed.savings == Savings(1.0, 1)
    one = predictor.solve(trimmed).layers
    assert (one[..., 3] == 255).all()
    assert (one[..., 0] == one[..., 1]).all()
    difference = np.abs(one.astype(np.int16) - three)
    assert difference.max() <= 4
    assert (difference > 0).mean() < 0.1


def test_pictures_that_turn_grey_and_back_leave_nothing_behind() -> None:
    predictor = load_predictor("balanced", STACK, ModelSettings())
    grey, coloured = grey_pictures(), grey_pictures(1)
    for side in coloured:
        side[60:90, 100:140, 2] = 10
    first = predictor.solve(drawn_job(coloured, EYES, STACK)).layers.copy()
    predictor.solve(replace(drawn_job(grey, EYES, STACK), channels=1))
    assert (predictor.solve(drawn_job(coloured, EYES, STACK)).layers == first).all()


def test_colour_in_one_eye_alone_is_kept() -> None:
    pictures = grey_pictures()
    pictures[1][100:140, 200:260, 0] = 250
    assert trim(drawn_job(pictures, EYES, STACK)).channels == 3
