"""Tests that cards are sharpest at their depth when a finite pupil focuses on them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.stack import PanelStack
from runtime.report import focal


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


def test_the_true_cards_are_sharpest_where_they_stand(stack: focal.FocalStack) -> None:
    for card in stack.cards:
        assert card.sharpest_true_m == pytest.approx(card.card_m, abs=0.008)


def test_through_the_layers_nearer_cards_are_sharpest_nearer(stack: focal.FocalStack) -> None:
    """Impossible on a flat panel: the depths in which the three cards are sharpest differ, in the right order."""
    behind, _, before = (card.sharpest_shown_m for card in stack.cards)
    assert behind > before


def test_the_retina_s_error_is_told(stack: focal.FocalStack) -> None:
    """A picture that is sharp everywhere is not what a pupil sees of cards at three depths."""
    assert 20 < stack.retina_db < 40
