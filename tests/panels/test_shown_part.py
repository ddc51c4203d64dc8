"""Tests which part of a screen shows the filled part of a layer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.rect import PixelRect
from runtime.panels.shown_part import ShownPicture, filled_part

BOX = PixelRect(30, 22, 70, 51)


def shown(
    to: Any = (1.0, 1.0, 0.0, 0.0), push: Any = (0.0, 0.0, 0.0, 0.0), *, columns: int = 120, rows: int = 90
) -> ShownPicture:
    screen = np.zeros((rows, columns, 4), np.uint8)
    return ShownPicture(screen, screen, source_from_panel=to, push=push, panel_px=(90, 120))


scales, shifts = st.floats(0.5, 2.0), st.floats(-30, 30)
pushes = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-5, 5), st.floats(-5, 5))


@given(st.tuples(scales, scales, shifts, shifts), pushes, st.sampled_from([0.0, 0.5, 2.0]))
def test_the_part_has_every_pixel_that_shows_the_box_and_hardly_more(to: Any, push: Any, rise: float) -> None:
    part = filled_part(shown(to, push), BOX, rise=rise, screen_from_panel=None)
    for axis, (count, begin, end) in enumerate(((120, part.u0, part.u1), (90, part.v0, part.v1))):
        first, last = (BOX.u0, BOX.u1) if axis == 0 else (BOX.v0, BOX.v1)
        at = np.arange(count) + 0.5
        source, moved = to[axis] * at + to[axis + 2], rise * np.abs(push[axis] * at + push[axis + 2])
        shows = (source + moved > first - 0.5) & (source - moved < last + 0.5)
        inside = (begin <= at) & (at < end)
        assert inside[shows].all()
        most = rise * np.abs(push[axis] * np.linspace(0, count, 50) + push[axis + 2]).max()
        far = (source + most < first - 5 - 5 * to[axis]) | (source - most > last + 5 + 5 * to[axis])
        assert not inside[far].any() and begin % 2 == 0


def test_the_part_of_a_registered_panel_is_that_of_its_corners() -> None:
    large = shown(columns=240, rows=180)
    assert filled_part(large, BOX, screen_from_panel=np.diag([2.0, 2.0, 1.0])) == PixelRect(54, 38, 146, 108)
    turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert filled_part(large, BOX, screen_from_panel=turned) == PixelRect(18, 26, 55, 74)
    oblique = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.002, 0.0, 1.0]])
    assert filled_part(large, BOX, screen_from_panel=oblique) == PixelRect(24, 14, 65, 53)
    for slope, box in ((-1 / 60, BOX), (-1 / 64, PixelRect(30, 22, 62, 51))):  # beyond and along an edge
        horizon = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [slope, 0.0, 1.0]])
        assert filled_part(large, box, screen_from_panel=horizon) == PixelRect(0, 0, 240, 180)


@pytest.mark.parametrize("box", [PixelRect(5, 5, 5, 9), PixelRect(5, 5, 9, 5)])
def test_nothing_is_filled_by_an_empty_box(box: PixelRect) -> None:
    part = filled_part(shown(), box, screen_from_panel=None)
    assert not part.width_px and not part.height_px
