"""Tests which edges count as outlines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.content import shapes
from runtime.content.fringe import OutlineRamps, edges_of
from runtime.content.shapes import Shape

TILTED = np.array([[0.3, 2, 0.1, 0], [0.1, 0.2, -2, 0], [0, 0, 0, 0], [-1, -0.1, 0.1, 100.0]])


def vertices_of(shape: Shape) -> Any:
    """(v, 12) positions, then attributes, of which the first is the vertex's number."""
    vertices = np.zeros((len(shape.positions_m), 12), np.float32)
    vertices[:, :3], vertices[:, 3] = shape.positions_m, np.arange(len(vertices))
    return vertices


def from_x(distance_m: float) -> Any:
    """Clip matrix of an eye on the x axis: a picture of 1 x 1 at a distance of 1."""
    return np.array([[0.0, 2, 0, 0], [0, 0, -2, 0], [0, 0, 0, 0], [-1, 0, 0, distance_m]])


AHEAD = from_x(100.0)


def ramps(shape: Shape, eye: list[float], clip: Any = AHEAD, **size: Any) -> Any:
    """Ramps (m, 4, 14) along the outline that an eye sees."""
    size = size or {"width_px": 4000, "height_px": 4000}
    found = OutlineRamps({7: (edges_of(shape), vertices_of(shape))}).along([(7, np.array(eye), clip)], **size)
    assert found[1] == [len(found[0])]
    return found[0].copy()


def ends(found: Any) -> Any:
    """(m, 2) numbers of the vertices at the ramps' ends."""
    assert np.array_equal(found[:, :2, 5:], found[:, 2:, 5:])
    return found[:, :2, 5].astype(int)


def test_the_diagonals_of_a_box_s_faces_are_no_outlines() -> None:
    box = shapes.box((1.0, 2.0, 3.0))
    edges = edges_of(box)
    assert len(edges.faces) == 12 + 6
    assert (edges.faces >= 0).all()
    assert len(ramps(box, [10.0, 0.0, 0.0])) == 4
    assert len(ramps(box, [10.0, 20.0, 30.0], TILTED)) == 6


def test_an_edge_behind_the_eye_has_no_ramp() -> None:
    card = shapes.card(1.0, 1.0)
    assert len(ramps(card, [100.0, 0.0, 0.0])) == 4
    assert len(ramps(card, [100.0, 0.0, 0.0], from_x(-1.0))) == 0


def test_a_sphere_s_outline_is_a_closed_ring() -> None:
    ball = shapes.sphere(1.0)
    at = ends(ramps(ball, [4.0, 1.0, 0.5], TILTED))
    places = np.unique(np.rint(ball.positions_m[at].reshape(-1, 3) * 1e4).astype(int), axis=0, return_counts=True)[1]
    assert (places == 2).all()


def test_the_ramp_is_one_pixel_wide_and_lies_outside() -> None:
    card = shapes.card(1.0, 1.0)
    plain = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 0], [0, 0, 0, 1]])
    corners = ramps(card, [5.0, 0.0, 0.0], plain, width_px=100, height_px=50)
    assert (corners[:, :2, 4] == 1).all() and (corners[:, 2:, 4] == 0).all()
    assert np.abs(corners[:, :2, :2]).max() == pytest.approx(0.5)
    reach = (np.abs(corners[:, 2:, :2]) - 0.5) * [50, 25]
    assert reach.reshape(-1, 4).max(axis=1) == pytest.approx(np.ones(4), abs=1e-4)
