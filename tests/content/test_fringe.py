"""Classification of edges as outlines."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.content import shapes
from runtime.content.fringe import edges_of, ramps, silhouette


def test_the_diagonals_of_a_box_s_faces_are_no_outlines() -> None:
    box = shapes.box((1.0, 2.0, 3.0))
    edges = edges_of(box)
    assert len(edges.faces) == 12 + 6
    assert (edges.faces >= 0).all()
    assert len(silhouette(edges, np.array([10.0, 0.0, 0.0]))[0]) == 4
    assert len(silhouette(edges, np.array([10.0, 20.0, 30.0]))[0]) == 6


def test_a_sphere_s_outline_is_a_closed_ring() -> None:
    ball = shapes.sphere(1.0)
    ends, _ = silhouette(edges_of(ball), np.array([4.0, 1.0, 0.5]))
    places = np.unique(np.rint(ball.positions_m[ends].reshape(-1, 3) * 1e4).astype(int), axis=0, return_counts=True)[1]
    assert (places == 2).all()


def test_the_ramp_is_one_pixel_wide_and_lies_outside() -> None:
    card = shapes.card(1.0, 1.0)
    ends, apex = silhouette(edges_of(card), np.array([5.0, 0.0, 0.0]))
    clip = np.column_stack([card.positions_m[:, 1], -card.positions_m[:, 2], np.zeros(4), np.ones(4)]).astype(float)
    corners, _ = ramps(clip[np.column_stack([ends, apex])], width_px=100, height_px=50)
    uncovered = corners[corners[..., 4] == 0]
    reach = (np.abs(uncovered[:, :2]) - 0.5) * [50, 25]
    assert reach.max(axis=1) == pytest.approx(np.ones(len(reach)), abs=1e-4)
