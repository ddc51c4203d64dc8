"""How a part of the panels ends: gently, where it isn't the panels' own edge."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.config import ModelSettings
from runtime.model.compiled.passes import fade_codes
from runtime.model.fade import Fade
from runtime.model.job import Job, Part
from runtime.model.predictor import load_predictor
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
EYES = np.array([[0.6, -0.031, 0.0], [0.6, 0.031, 0.0]])


def test_weights_rise_from_nothing_at_the_edge_to_one_inside() -> None:
    fade = Fade(PixelRect(10, 0, 90, 50), over_px=(20.0, 0.0), right=False)
    weights = fade.wave_weights(np.eye(3), rows=50, columns=100)[0, :, 0]
    assert (weights[:10] == 0).all()
    assert (np.diff(weights[10:30]) > 0).all()
    assert (weights[30:] == 1).all()


def test_a_sheared_raster_is_weighed_in_the_panel_s_own_directions() -> None:
    fade = Fade(PixelRect(0, 0, 100, 100), over_px=(0.0, 10.0))
    sheared = np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    weights = fade.wave_weights(sheared, rows=60, columns=60)[..., 0]
    assert weights[0, 0] < 0.1
    assert weights[0, 30] == 1.0  # fifteen rows further down
    assert weights[20, 0] == 1.0


@pytest.mark.parametrize("rows", [1, 6])
def test_codes_fade_towards_the_middle(rows: int) -> None:
    codes = np.random.default_rng(4).integers(0, 4400, (6, 8, 3)).astype(np.int16)
    weights = np.linspace(0, 1.2, rows * 8, dtype=np.float32).reshape(rows, 8).clip(0, 1)
    wanted = (codes * weights[..., None] + (2040 * (1 - weights[..., None]) + np.float32(0.5))).astype(np.int16)
    wanted = np.where(weights[..., None] < 1, wanted, codes)
    found = codes.copy()
    fade_codes(found.reshape(6, -1), weights, 2040, 3)
    assert (found == wanted).all()


def test_outer_panels_stay_even_beside_what_is_kept() -> None:
    predictor = load_predictor("balanced", STACK, ModelSettings())
    pictures = [[np.full((270, 480, 4), 128, np.uint8)] for _ in EYES]
    for side, shift in enumerate((3, -3)):
        pictures[side][0][100:160, 220 + shift : 260 + shift, :3] = (250, 60, 20)
    part = Part(PixelRect(24, 0, 456, 270), PixelRect(150, 60, 330, 200), (60.0, 0.0))
    outer = predictor.solve(Job(pictures, EYES, part=part)).layers[[0, 2], ..., :3].astype(np.int16)
    assert np.abs(outer - 128).max() > 20
    assert np.abs(outer[:, :, :120] - 128).max() <= 1
    assert np.abs(outer[:, :, 360:] - 128).max() <= 1
