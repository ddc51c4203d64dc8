"""Pictures with a projection of their own."""

from __future__ import annotations

import numpy as np

from runtime.content.images import WarpedPicture, image_from_view, rgba_from_rgb
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from tests.content.conftest import image_view, panel_view

EYE = (0.7, -0.03, 0.1)


def test_the_picture_s_own_view_gives_back_the_picture() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (90, 160, 3), np.uint8)
    view = image_view(EYE, 160, 90)
    matrix = image_from_view(view.pixels_from_stack, view.pixels_from_stack, x_m=0.0)
    picture = WarpedPicture(rgba_from_rgb(rgb), background=(1.0, 1.0, 1.0)).warped(matrix, view)
    assert (picture[1:-1, 1:-1, :3] == rgb[1:-1, 1:-1]).all()


def test_a_picture_much_larger_than_the_raster_is_averaged_and_not_picked_from(stack: PanelStack) -> None:
    lines = np.zeros((1080, 1920, 3), np.uint8)
    lines[:, ::2] = 255
    view = panel_view(EYE, stack.panel(1))
    projection = image_from_stack(EYE, width_px=1920, height_px=1080, fov_deg=60)
    matrix = image_from_view(projection, view.pixels_from_stack, x_m=0.0)
    picture = WarpedPicture(rgba_from_rgb(lines), background=(1.0, 1.0, 1.0)).warped(matrix, view)
    inner = picture[60:-60, 60:-60, 0].astype(int)
    assert np.abs(inner - 128).max() < 32
