"""Tests that the depth of drawn content is where rays meet it, in blocks of pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.parts import Part
from runtime.content.shapes import card, rotation_about
from runtime.content.splat import SplatSource
from runtime.content.triangles import DrawnPart, TriangleSource
from runtime.support.artifacts import write_png
from tests.content.conftest import STACK, panel_view
from tests.content.test_splat import loaded, splat_table, written

EYES = ((0.6, 0.02, 0.03), (0.35, -0.2, 0.1))
WHOLE = {"every": 1, "first": (0, 0)}


def plane_nearness(view: View, point_m: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(h, w) 1/m where each pixel's ray from the eye meets a plane, in float64."""
    v, u = np.mgrid[: view.height_px, : view.width_px] + 0.5
    ways = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.pixels_from_stack[:, :3]).T
    return (ways @ normal) / (normal @ (point_m - view.eye_m))  # rays advance by 1 in the third coordinate


def drawn(source: ContentSource, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Depth of every pixel, and which are wholly covered, with covered neighbours."""
    alpha = source.render(view, time_ns=0)[..., 3].copy()
    found = source.nearness(view, **WHOLE)
    assert found is not None
    assert found.shape == alpha.shape
    inner = np.zeros(alpha.shape, bool)
    inner[1:-1, 1:-1] = np.lib.stride_tricks.sliding_window_view(alpha == 255, (3, 3)).all((2, 3))
    assert inner.sum() > 500
    return found, inner


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("samples", [0, 4])
def test_a_tilted_card_is_as_far_as_rays_meet_its_plane(context: Any, eye: tuple[float, ...], samples: int) -> None:
    turn, place = rotation_about(2, 0.5) @ rotation_about(1, 0.4), np.eye(4)
    place[:3, :3], place[:3, 3] = turn, (0.03, 0.02, -0.01)
    part = DrawnPart(Part(card(0.3, 0.2)), outlined=not samples)
    source = TriangleSource([part], [place], context=context, info=ContentInfo("a"), samples=samples)
    view = panel_view(eye, STACK.panel(1))
    found, inner = drawn(source, view)
    expected = plane_nearness(view, place[:3, 3], turn[:, 0])
    anywhere_in_it = np.abs(np.gradient(expected)).sum(0) / 2  # of several samples one is read
    off = np.abs(found - expected) - (anywhere_in_it if samples else 0.0)
    assert (off / expected)[inner].max() < 1e-4
    assert (found[source.render(view, time_ns=0)[..., 3] == 0] == 0).all()
    source.close()


def test_an_rgbd_picture_has_the_depths_of_its_map(tmp_path: Path, opened: Any) -> None:
    """Drawn with several samples a pixel: left half in front, right half behind."""
    picture = np.full((90, 320, 3), 120, np.uint8)
    picture[:, 160:240], picture[:, 240:] = 255, 0
    write_png(tmp_path / "a_rgbd.png", picture)
    source = opened(tmp_path / "a_rgbd.png", depth_m=(-0.05, 0.05))
    view = panel_view(EYES[0], STACK.panel(1))
    found, _ = drawn(source, view)
    for columns, x_m in ((slice(60, 180), 0.05), (slice(320, 420), -0.05)):
        expected = plane_nearness(view, np.array([x_m, 0, 0]), np.array([1.0, 0, 0]))
        np.testing.assert_allclose(found[40:230, columns], expected[40:230, columns], rtol=1e-4)


@pytest.mark.parametrize("opacity", [6.0, 0.5])
def test_a_sheet_of_splats_is_as_far_as_its_plane(tmp_path: Path, context: Any, opacity: float) -> None:
    """Dense splats in one plane; fainter ones before it are seen through and do not count."""
    table = splat_table(6000, degree=0)
    table["opacity"], table["z"] = opacity, 0.04 + 0.1 * table["y"]
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(0.06)
    table["opacity"][::10], table["z"][::10] = -1.5, 0.3
    source = SplatSource(
        loaded(written(tmp_path, table)), stack_from_scene=np.diag([0.1, 0.1, 0.1, 1.0]), context=context,
        info=ContentInfo("a"),
    )  # fmt: skip
    source._gaussians.centres[:] = source._gaussians.centres[:, [2, 1, 0]]
    view = panel_view(EYES[0], STACK.panel(1))
    found, _ = drawn(source, view)
    expected = plane_nearness(view, np.array([0.004, 0, 0]), np.array([1.0, -0.1, 0]))
    middle = (slice(60, 210), slice(150, 330))
    assert (found[middle] > 0).mean() > 0.99
    held = found[middle] > 0
    np.testing.assert_allclose(found[middle][held], expected[middle][held], rtol=4e-3)
    coarse = source.nearness(view, every=4, first=(3, 1))
    assert coarse is not None
    assert coarse.shape == (68, 121)
    np.testing.assert_allclose(coarse[16:52, 39:82], expected[62:206:4, 154:326:4], rtol=1e-2)
    source.close()


def test_a_source_without_depth_has_none(tmp_path: Path, opened: Any) -> None:
    write_png(tmp_path / "a.png", np.full((90, 160, 3), 90, np.uint8))
    source = opened(tmp_path / "a.png", rotation_deg=(0, 5, 0))
    view = panel_view(EYES[0], STACK.panel(1))
    assert source.nearness(view, **WHOLE) is None
    source.render(view, time_ns=0)
    assert source.nearness(view, **WHOLE) is None


def test_a_playlist_has_the_depth_of_what_it_shows(tmp_path: Path, opened: Any) -> None:
    write_png(tmp_path / "a.png", np.full((90, 160, 3), 90, np.uint8))
    (tmp_path / "list.toml").write_text(
        "[[show]]\nscene = 'demo'\nseconds = 2\nscale = 0.8\n[[show]]\nscene = 'a.png'\nseconds = 2\n"
    )
    shown = opened(tmp_path / "list.toml")
    alone = opened("demo", scale=0.8)
    view = panel_view(EYES[0], STACK.panel(1))
    assert shown.nearness(view, **WHOLE) is None
    for source in (shown, alone):
        source.render(view, time_ns=0)
    first, expected = shown.nearness(view, **WHOLE), alone.nearness(view, **WHOLE)
    assert first is not None
    assert first.any()
    np.testing.assert_array_equal(first, expected)
    shown.render(view, time_ns=3 * NS_PER_S)
    assert shown.nearness(view, **WHOLE) is None
