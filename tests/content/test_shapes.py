"""Tests that solid shapes are recognised, whichever way their triangles are wound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from runtime.content import shapes
from runtime.content.shapes import Shape, join, solid_winding

SOLIDS = {
    "box": shapes.box((1.0, 2.0, 3.0)),
    "sphere": shapes.sphere(1.0),
    "torus": shapes.torus(1.0, 0.3),
    "letters": shapes.lettering("PHASE3D", cell_m=0.1, depth_m=0.1),
    "fence": shapes.fence(1.0, 1.0, bars=5, bar_m=0.02),
}


def turned_inside_out(shape: Shape) -> Shape:
    return replace(shape, triangles=np.ascontiguousarray(shape.triangles[:, ::-1]))


@pytest.mark.parametrize("shape", SOLIDS.values(), ids=SOLIDS.keys())
def test_a_solid_shape_s_winding_is_that_of_its_normals(shape: Shape) -> None:
    corners = shape.positions_m[shape.triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    agree = (faces * shape.normals[shape.triangles[:, 0]]).sum(1)
    assert solid_winding(shape) == np.sign(agree.sum())
    assert solid_winding(turned_inside_out(shape)) == -np.sign(agree.sum())


@pytest.mark.parametrize("shape", SOLIDS.values(), ids=SOLIDS.keys())
def test_a_shape_with_a_hole_is_not_solid(shape: Shape) -> None:
    assert solid_winding(replace(shape, triangles=np.delete(shape.triangles, len(shape.triangles) // 2, axis=0))) == 0


def test_bodies_of_opposite_winding_are_not_solid_together() -> None:
    ball = shapes.sphere(1.0)
    beside = ball.moved(offset_m=(3.0, 0.0, 0.0))
    assert solid_winding(join([ball, beside])) == solid_winding(ball)
    assert solid_winding(join([ball, turned_inside_out(beside)])) == 0


def test_a_card_or_nothing_is_not_solid() -> None:
    card = shapes.card(1.0, 1.0)
    assert solid_winding(card) == 0
    assert solid_winding(replace(card, triangles=card.triangles[:0])) == 0
