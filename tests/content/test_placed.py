"""Tests that any scene can be moved, turned, scaled and put on a turntable."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource, ForwardingSource, View
from runtime.content.camera import pixels_and_depths
from runtime.content.placed import PlacedSource, Placing, placed_source
from runtime.content.registry import open_content
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.support.artifacts import write_png
from tests.content.conftest import STACK, panel_view

EYE = (0.6, 0.02, 0.03)


def middle_of(picture: np.ndarray) -> np.ndarray:
    """Column and row of the drawing's middle."""
    rows, columns = np.nonzero(picture[..., 3] == 255)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


def test_an_offset_moves_it_to_where_the_projection_says(drawn: Any) -> None:
    offset = np.array([0.03, 0.08, -0.05])
    there = middle_of(drawn("sparse", EYE, offset_m=tuple(offset)))
    view = panel_view(EYE, STACK.panel(1))
    centre = np.array([0.02, 0.03, 0.0])  # of the ring
    expected = pixels_and_depths(view.pixels_from_stack, (centre + offset)[None])[0][0]
    assert np.abs(there - expected).max() < 2.5


def test_convergence_moves_the_views_apart_by_itself(opened: Any) -> None:
    views = [panel_view(EYE, STACK.panel(1), side=side) for side in (0, 1)]
    places = []
    for convergence_m in (0.0, 0.02):
        source = opened("sparse", convergence_m=convergence_m)
        places.append([middle_of(source.render(view, time_ns=0).copy()) for view in views])
    apart = (np.array(places[1]) - places[0])[:, 0] * STACK.width_m / STACK.width_px
    assert apart == pytest.approx([-0.01, 0.01], abs=0.001)


def test_scale_is_about_the_displays_middle(drawn: Any) -> None:
    small, large = (drawn("sparse", EYE, scale=scale) for scale in (0.5, 1.5))
    areas = [(picture[..., 3] == 255).sum() for picture in (small, large)]
    assert areas[1] / areas[0] == pytest.approx(9, rel=0.15)


def test_a_turn_about_the_axis_out_of_the_screen_turns_the_picture(tmp_path: Path, context: Any) -> None:
    square = PanelStack(0.3, 0.3, (-0.06, 0.0, 0.06), 200, 200)
    picture = np.full((100, 100, 3), 255, np.uint8)
    picture[:50, 50:] = (255, 0, 0)  # red above right
    write_png(tmp_path / "a.png", picture)
    source = open_content(ContentSettings(scene=str(tmp_path / "a.png"), rotation_deg=(90, 0, 0)), square, context)
    seen = source.render(panel_view((0.6, 0, 0), square.panel(1)), time_ns=0)
    # From +y (right) towards +z (up): the upper right becomes the upper left.
    assert seen[50, 50, :3].tolist() == [255, 0, 0]
    assert seen[50, 150, :3].tolist() == [255, 255, 255]
    assert source.info.flat_x_m == 0.0


def test_a_turntable_turns_by_the_clock(opened: Any) -> None:
    source = opened("sparse", turntable_per_min=6)
    assert isinstance(source, PlacedSource) and source.info.moving
    view = panel_view(EYE, STACK.panel(1))
    pictures = [source.render(view, time_ns=second * NS_PER_S).copy() for second in (0, 5, 10)]
    assert (pictures[0] != pictures[1]).any()
    assert (pictures[0] == pictures[2]).all()  # six turns a minute
    assert source.revision(time_ns=1) != source.revision(time_ns=2)
    assert placed_source(source, Placing()) is source.source  # a new placement replaces the old one


def test_the_lamp_stands_still_while_the_scene_turns(context: Any) -> None:
    """A ball without a picture looks alike from everywhere, if the lamp doesn't turn with it."""
    from runtime.content import shapes
    from runtime.content.procedural import ProceduralSource
    from runtime.content.scenes import Scene, Thing

    ball = Scene("ball", (Thing(shapes.sphere(0.05), "plain", (0.0, 0.0, 0.0), (0.5, 0.5, 0.5)),))
    inner = ProceduralSource(ball, stack=STACK, context=context)
    view = panel_view((0.6, 0, 0), STACK.panel(1))
    stands = inner.render(view, time_ns=0).astype(int)
    turned = PlacedSource(inner, Placing(rotation_deg=(0, 0, 90))).render(view, time_ns=0).astype(int)
    inside = (stands[..., 3] == 255) & (turned[..., 3] == 255)
    assert np.abs(stands - turned)[inside].max() <= 6
    inner.close()


def test_a_picture_turned_edge_on_is_the_background_and_no_error(tmp_path: Path, context: Any) -> None:
    stack = PanelStack(0.3, 0.3, (-0.06, 0.0, 0.06), 64, 64)
    write_png(tmp_path / "a.png", np.zeros((10, 10, 3), np.uint8))
    source = open_content(ContentSettings(scene=str(tmp_path / "a.png")), stack, context)
    turned = PlacedSource(source, Placing(rotation_deg=(0, 0, 90)))
    assert (turned.render(panel_view((0.6, 0, 0), stack.panel(1)), time_ns=0) == (31, 31, 31, 0)).all()


def test_depth_is_that_of_the_place_in_blocks_of_pixels(opened: Any) -> None:
    """The nearest point of a scene that is moved 5 cm nearer is seen 5 cm nearer; blocks keep their nearest pixel."""
    view = panel_view(EYE, STACK.panel(1))
    nearest_m = []
    for offset_m in (0.0, 0.05):
        content = opened("demo", offset_m=(offset_m, 0.0, 0.0))
        content.render(view, time_ns=0)
        fine = content.nearness(view, every=1, first=(0, 0))
        coarse = content.nearness(view, every=4, first=(3, 1))
        assert fine is not None and coarse is not None and (fine == 0.0).any()
        assert fine.shape == (view.height_px, view.width_px)
        padded = np.zeros((4 * coarse.shape[0], 4 * coarse.shape[1]), np.float32)
        padded[1:, 3:][: fine.shape[0], : fine.shape[1]] = fine
        np.testing.assert_allclose(coarse, padded.reshape(coarse.shape[0], 4, -1, 4).max((1, 3)), rtol=1e-5)
        nearest_m.append(1 / fine.max())
    assert nearest_m[0] - nearest_m[1] == pytest.approx(0.05, abs=1e-3)


class Inner(ContentSource):
    """Source that only notes what it is asked."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def __getattribute__(self, name: str) -> Any:
        if name in MEMBERS:
            self.asked.append(name)
        return super().__getattribute__(name)

    def render(self, view: View, *, time_ns: int) -> U8:
        return np.zeros((1, 1, 4), np.uint8)


class Outer(ForwardingSource):
    """Source that shows another one, unchanged."""

    def __init__(self, source: ContentSource) -> None:
        self.source, self.info = source, ContentInfo("outer")

    def forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        return self.source, view, time_ns


MEMBERS = [name for name in vars(ContentSource) if not name.startswith("_") and name != "Options"]


@pytest.mark.parametrize("name", MEMBERS)
def test_a_forwarding_source_forwards_every_request(name: str) -> None:
    inner = Inner()
    inner.info = ContentInfo("inner")
    outer = Outer(inner)
    view = panel_view(EYE, STACK.panel(1))
    outer.render(view, time_ns=0)  # `nearness` is asked of the source that drew last
    inner.asked.clear()
    member = getattr(outer, name)
    if callable(member):
        given = {"view": view, "views": [view], "time_ns": 0, "every": 1, "first": (0, 0)}
        member(**{key: given[key] for key in inspect.signature(member).parameters})
    assert inner.asked == [name]
