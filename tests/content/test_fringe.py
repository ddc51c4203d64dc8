"""Tests which edges count as outlines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.content import shapes
from runtime.content.fringe import Outlines, edges_of, ramps
from runtime.content.shapes import Shape


def outline(shape: Shape, eye: list[float]) -> Any:
    """(k, 3) both ends and the apex of every edge on the outline that an eye sees."""
    return Outlines([edges_of(shape)], vertices=[len(shape.positions_m)]).seen([np.array(eye)])[0]


def test_the_diagonals_of_a_box_s_faces_are_no_outlines() -> None:
    box = shapes.box((1.0, 2.0, 3.0))
    edges = edges_of(box)
    assert len(edges.faces) == 12 + 6
    assert (edges.faces >= 0).all()
    assert len(outline(box, [10.0, 0.0, 0.0])) == 4
    assert len(outline(box, [10.0, 20.0, 30.0])) == 6


def test_outlines_of_several_parts_are_those_of_each() -> None:
    parts = [shapes.box((1.0, 2.0, 3.0)), shapes.card(1.0, 1.0), shapes.sphere(1.0)]
    eyes = [np.array([10.0, 3.0 * n, 1.0]) for n in range(3)]
    counts = [len(shape.positions_m) for shape in parts]
    together = Outlines([edges_of(shape) for shape in parts], vertices=counts)
    seen, of_part = together.seen(eyes)
    for n, shape in enumerate(parts):
        assert np.array_equal(seen[of_part == n] - sum(counts[:n]), outline(shape, list(eyes[n])))
    assert set(together.seen([eyes[0], None, eyes[2]])[1]) == {0, 2}, "a part without an inside has no outline"


def test_a_sphere_s_outline_is_a_closed_ring() -> None:
    ball = shapes.sphere(1.0)
    ends = outline(ball, [4.0, 1.0, 0.5])[:, :2]
    places = np.unique(np.rint(ball.positions_m[ends].reshape(-1, 3) * 1e4).astype(int), axis=0, return_counts=True)[1]
    assert (places == 2).all()


def test_the_ramp_is_one_pixel_wide_and_lies_outside() -> None:
    card = shapes.card(1.0, 1.0)
    seen = outline(card, [5.0, 0.0, 0.0])
    clip = np.column_stack([card.positions_m[:, 1], -card.positions_m[:, 2], np.zeros(4), np.ones(4)]).astype(float)
    corners, _ = ramps(clip[seen], width_px=100, height_px=50)
    uncovered = corners[corners[..., 4] == 0]
    reach = (np.abs(uncovered[:, :2]) - 0.5) * [50, 25]
    assert reach.max(axis=1) == pytest.approx(np.ones(len(reach)), abs=1e-4)
