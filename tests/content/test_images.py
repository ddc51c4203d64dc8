"""Pictures with a projection of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runtime.content.base import View
from runtime.content.images import WarpedPicture, image_from_view, rgba_from_rgb
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64, U8
from tests.content.conftest import image_view, panel_view

LEFT, RIGHT = (0.7, -0.03, 0.1), (0.7, 0.03, 0.1)
WHITE = (1.0, 1.0, 1.0)


class Pair:
    """Two pictures (h, w, 3), each warped from its own projection (3, 4)."""

    def __init__(
        self, *pictures: U8, projections: Sequence[F64], background: tuple[float, float, float] = WHITE
    ) -> None:
        self._pictures = [WarpedPicture(rgba_from_rgb(rgb), background=background) for rgb in pictures]
        self._projections = projections

    def render(self, view: View) -> U8:
        matrix = image_from_view(self._projections[view.side], view.pixels_from_stack, x_m=0.0)
        return self._pictures[view.side].warped(matrix, view)


def test_the_picture_s_own_view_gives_back_the_picture() -> None:
    random = np.random.default_rng(0)
    pictures = random.integers(0, 256, (2, 90, 160, 3), np.uint8)
    views = [image_view(eye, 160, 90, side=side) for side, eye in enumerate((LEFT, RIGHT))]
    pair = Pair(*pictures, projections=[view.pixels_from_stack for view in views])
    for side, view in enumerate(views):
        assert (pair.render(view)[1:-1, 1:-1, :3] == pictures[side][1:-1, 1:-1]).all()


def test_a_picture_much_larger_than_the_raster_is_averaged_and_not_picked_from(stack: PanelStack) -> None:
    lines = np.zeros((1080, 1920, 3), np.uint8)
    lines[:, ::2] = 255
    projection = image_from_stack(LEFT, width_px=1920, height_px=1080, fov_deg=60)
    picture = Pair(lines, lines, projections=[projection] * 2).render(panel_view(LEFT, stack.panel(1)))
    inner = picture[60:-60, 60:-60, 0].astype(int)
    assert np.abs(inner - 128).max() < 32
