"""Tests that cards are sharpest at their depth when a finite pupil focuses on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.carried import intensities
from runtime.optics.focus import retina_db
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64
from runtime.report import focal
from runtime.report.pairs import eyes_at


@given(st.floats(0.3, 0.6), st.floats(1.0, 50.0))
def test_the_sharpest_distance_is_the_top_of_the_curve(top: float, steepness: float) -> None:
    distances = np.linspace(0.2, 0.7, 11)
    values = 10 - steepness * (distances - top) ** 2
    assert focal.sharpest(distances.tolist(), values.tolist()) == pytest.approx(top, abs=1e-6)


@pytest.fixture(scope="module")
def stack() -> focal.FocalStack:
    panels = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
    with focal.cards_painter(panels) as painter:
        return focal.focal_stack(painter, panels, model="fast")


@pytest.mark.slow
def test_cards_are_sharpest_where_they_stand_and_layers_keep_their_order(stack: focal.FocalStack) -> None:
    """On a flat panel, all three cards are sharpest in one plane. What is sharp everywhere is not what a pupil sees."""
    for card in stack.cards:
        assert card.sharpest_true_m == pytest.approx(card.card_m, abs=0.008)
    behind, _, before = (card.sharpest_shown_m for card in stack.cards)
    assert behind > before
    assert 20 < stack.retina_db < 40


@pytest.mark.slow
def test_pictures_for_points_of_the_pupils_put_the_cards_where_they_stand() -> None:
    """Solved for pinhole eyes, the rear and the front card are sharpest near the middle panel."""
    stack = PanelStack(0.162, 0.0648, (-0.06, 0.0, 0.06), 600, 240)  # pixels of the default display, without its edges
    eye_m = eyes_at(distance_m=focal.DISTANCE_M)[1]
    pixels = focal.seen_pixels(stack)
    front = focal.card_windows(pixels, eye_m)[2]
    size = {"width_px": pixels.raster.width_px, "height_px": pixels.raster.height_px}
    with focal.cards_painter(PanelStack(0.5184, 0.2916, stack.x_m, 1920, 1080)) as painter:

        def drawn(point_m: F64, matrix: F64) -> F32:
            return intensities(painter.draw(point_m, matrix, **size))

        true = [pixels.true(drawn, eye_m, plane_m=plane_m) for plane_m in focal.FOCUSED_M]
        found = {}
        for focus in (False, True):
            layers = focal.cards_layers(painter, stack, eyes_at(distance_m=0.4), model="best", focus=focus)[..., :3]
            shown = [pixels.seen(layers, stack, eye_m, plane_m=plane_m) for plane_m in focal.FOCUSED_M]
            found[focus] = retina_db(zip(shown, true, strict=True)), blur([retina.image for retina in shown], front)
    assert found[True][0] > found[False][0] + 3.0
    assert found[True][1] > 1.5 * found[False][1]


def blur(pictures: Sequence[F32], front: tuple[slice, slice]) -> float:
    """How much less contrast the front card has if the eye focuses on the rear one, as a share."""
    rear, _, own = (focal.contrast(picture, front) for picture in pictures)
    return 1 - rear / own
