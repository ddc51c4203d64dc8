"""Tests where points of the built-in scenes appear, what is in front, and that runs are equal."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from runtime.content import shapes
from runtime.content.base import View
from runtime.content.camera import clip_from_stack, depth_bounds, pixels_and_depths
from runtime.content.procedural import ProceduralSource
from runtime.content.scenes import SCENES, Scene, Thing
from runtime.content.triangles import DrawnPart, _Look
from runtime.optics.stack import PanelStack
from tests.content.conftest import STACK, image_view, panel_view

EYES = {
    "ahead": (0.7, -0.03, 0.1),
    "near": (0.3, 0.03, -0.05),
    "65 degrees to the right": (0.25, 0.25 * np.tan(np.radians(65)), 0.1),
    "65 degrees to the left": (0.25, -0.25 * np.tan(np.radians(65)), 0.0),
    "from above": (0.4, 0.0, 0.5),
}
POINTS = ((0.0, 0.0, 0.0), (-0.1, 0.03, 0.02), (0.09, -0.02, -0.03))


def bead(centre_m: tuple[float, float, float], colour: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Thing:
    return Thing(shapes.sphere(0.004), "plain", centre_m, colour, lit=False)


def centroid_px(picture: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(picture[..., 3] > 0)
    weight = picture[rows, columns, 3].astype(float)
    return np.array([np.average(columns + 0.5, weights=weight), np.average(rows + 0.5, weights=weight)])


@pytest.mark.parametrize("eye", EYES.values(), ids=EYES.keys())
@pytest.mark.parametrize("point", POINTS)
def test_a_point_lands_where_the_projection_says(
    context: Any, eye: tuple[float, ...], point: tuple[float, float, float]
) -> None:
    source = ProceduralSource(Scene("bead", (bead(point),)), stack=STACK, context=context)
    seen = 0
    for view in (
        panel_view(eye, STACK.panel(1)),
        panel_view(eye, STACK.panel(0)),
        image_view(eye, 640, 360, fov_deg=60),
    ):
        expected = pixels_and_depths(view.pixels_from_stack, np.array([point]))[0][0]
        margin = 20
        if not (margin < expected[0] < view.width_px - margin and margin < expected[1] < view.height_px - margin):
            continue
        seen += 1
        found = centroid_px(source.render(view, time_ns=0))
        assert np.abs(found - expected).max() < 0.25
    source.close()
    assert seen >= 1


@pytest.mark.parametrize("make", [panel_view, image_view], ids=["raster", "image"])
def test_the_nearer_of_two_surfaces_hides_the_other(context: Any, make: Any) -> None:
    eye = np.array([0.6, 0.1, 0.05])
    front, rear = eye * 0.1, eye * -0.1
    red, blue = bead(tuple(front), (1.0, 0.0, 0.0)), bead(tuple(rear), (0.0, 0.0, 1.0))
    view = panel_view(eye, STACK.panel(1)) if make is panel_view else image_view(eye, 480, 270)
    for parts in ((red, blue), (blue, red)):
        source = ProceduralSource(Scene("two", parts), stack=STACK, context=context)
        picture = source.render(view, time_ns=0)
        u, v = (int(value) for value in pixels_and_depths(view.pixels_from_stack, front[None])[0][0])
        assert picture[v, u].tolist() == [255, 0, 0, 255]
        source.close()


def test_the_same_view_and_time_give_the_same_bytes_in_any_context(context: Any) -> None:
    from runtime.support.gl import offscreen_context

    view = panel_view(EYES["ahead"], STACK.panel(1))
    first = ProceduralSource("demo", stack=STACK, context=context).render(view, time_ns=0).copy()
    with offscreen_context() as other:
        second = ProceduralSource("demo", stack=STACK, context=other).render(view, time_ns=10**10).copy()
    assert first.tobytes() == second.tobytes()


def test_alpha_is_zero_exactly_where_only_the_background_shows(context: Any) -> None:
    source = ProceduralSource("sparse", stack=STACK, context=context, background=(1.0, 0.4, 0.0))
    picture = source.render(panel_view(EYES["ahead"], STACK.panel(1)), time_ns=0)
    empty = picture[..., 3] == 0
    assert 0.9 < empty.mean() < 0.99
    assert (picture[empty][:, :3] == [255, 102, 0]).all()
    assert (picture[..., 3] == 255).mean() > 0.01


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_is_what_it_says_of_itself(context: Any, name: str) -> None:
    source = ProceduralSource(name, stack=STACK, context=context)
    view = panel_view(EYES["ahead"], STACK.panel(1))
    picture = source.render(view, time_ns=0).copy()
    later = source.render(view, time_ns=10**9)
    assert source.info.moving == bool((picture != later).any())
    assert source.info.moving == (source.revision(time_ns=0) != source.revision(time_ns=10**9))
    assert source.info.grey == bool((np.ptp(picture[..., :3].astype(int), axis=2) == 0).all())
    assert (name == "texture") == bool((picture[..., 3] == 255).all())
    source.close()


@pytest.mark.parametrize("eye", [EYES["ahead"], EYES["near"]])
def test_outlines_are_smooth_and_grow_by_less_than_a_pixel(context: Any, eye: tuple[float, ...]) -> None:
    fine = PanelStack(STACK.width_m, STACK.height_m, STACK.x_m, STACK.width_px * 4, STACK.height_px * 4)
    one_sample = ProceduralSource("demo", stack=STACK, context=context)
    one_sample._ramps = None
    exact = one_sample.render(panel_view(eye, fine.panel(1)), time_ns=0)
    wanted = cv2.resize(exact, (STACK.width_px, STACK.height_px), interpolation=cv2.INTER_AREA)[..., 3].astype(float)
    hard = one_sample.render(panel_view(eye, STACK.panel(1)), time_ns=0)[..., 3].astype(float)
    source = ProceduralSource("demo", stack=STACK, context=context)
    smooth = source.render(panel_view(eye, STACK.panel(1)), time_ns=0)[..., 3].astype(float)
    # A staircase is where coverage jumps from nothing to all between two rows.
    assert (np.abs(np.diff(smooth, axis=0)) == 255).mean() < 0.5 * (np.abs(np.diff(hard, axis=0)) == 255).mean()
    outline_px = ((wanted > 0) & (wanted < 255)).sum()
    assert 0.2 < (smooth - wanted).sum() / 255 / outline_px < 0.8


@pytest.mark.parametrize("eye", EYES.values(), ids=EYES.keys())
def test_leaving_out_the_back_faces_of_solid_things_changes_no_picture(
    context: Any, monkeypatch: pytest.MonkeyPatch, eye: tuple[float, ...]
) -> None:
    source = ProceduralSource("demo", stack=STACK, context=context)
    source._with_ramps = False
    view = panel_view(eye, STACK.panel(1))
    culled = source.render(view, time_ns=0).astype(int)
    assert sum(part.front_faces(_look(source, view, n)) is not None for n, part in enumerate(source.parts)) == 6
    monkeypatch.setattr(DrawnPart, "front_faces", lambda *_: None)
    drawn = source.render(view, time_ns=0).astype(int)
    assert (np.abs(culled - drawn).max(axis=2) > 2).sum() <= 10  # back faces may show through at an outline's pixels


def test_an_eye_in_a_solid_thing_sees_its_inside(context: Any) -> None:
    around = Thing(shapes.box((2.0, 2.0, 2.0)), "plain", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), lit=False)
    source = ProceduralSource(Scene("inside", (around,)), stack=STACK, context=context)
    assert (source.render(panel_view(EYES["ahead"], STACK.panel(1)), time_ns=0) == [255, 0, 0, 255]).all()


def _look(source: ProceduralSource, view: View, part: int) -> _Look:
    arranged = source._arranged(0)
    near_m, far_m = depth_bounds(view, arranged.corners_m.reshape(-1, 3))
    return _Look(arranged.places[part], clip_from_stack(view, near_m=near_m, far_m=far_m), view)
