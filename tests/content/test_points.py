"""Point clouds: where points land, what hides what, and what a broken file is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from runtime.config import LIMITS, ContentSettings
from runtime.content.camera import project
from runtime.content.ply import read_header
from runtime.content.points import load_points
from runtime.content.registry import open_content
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from tests.content.conftest import panel_view

EYE = (0.6, 0.0, 0.0)


def cloud(path: Path, points: np.ndarray, colours: np.ndarray | None = None, **options: Any) -> Path:
    trimesh.PointCloud(points, colors=colours).export(path, **options)
    return path


def drawn(path: Path, context: Any, stack: PanelStack, **settings: Any) -> np.ndarray:
    source = open_content(ContentSettings(scene=str(path), **settings), stack, context)
    picture = source.render(panel_view(EYE, stack.panel(1)), time_ns=0).copy()
    source.close()
    return picture


def test_points_are_where_they_are_in_their_colours(tmp_path: Path, context: Any, stack: PanelStack) -> None:
    """A file's own metres: x out of the screen, y to the right, z up."""
    points = np.array([[0.02, -0.1, 0.05], [0.0, 0.1, 0.05], [-0.02, 0.0, -0.08]])
    colours = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]], np.uint8)
    picture = drawn(cloud(tmp_path / "a.ply", points, colours), context, stack, fit=False)
    places = project(panel_view(EYE, stack.panel(1)).pixels_from_stack, points)[0]
    for (u, v), colour in zip(places, colours, strict=True):
        assert picture[int(v), int(u)].tolist() == colour.tolist()


def test_what_is_nearer_hides_what_is_behind_and_the_surface_is_closed(
    tmp_path: Path, context: Any, stack: PanelStack
) -> None:
    y, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.1, 0.1, 80), np.linspace(-0.1, 0.1, 80)))
    near = np.column_stack([np.full_like(y, 0.03), y, z])
    far = near - [0.06, 0.0, 0.0]
    colours = np.repeat([[0, 255, 0, 255], [255, 0, 0, 255]], len(y), axis=0).astype(np.uint8)
    picture = drawn(cloud(tmp_path / "a.ply", np.concatenate([near, far]), colours), context, stack, fit=False)
    middle = picture[100:170, 200:280]
    assert (middle[..., 3] == 255).mean() > 0.99
    assert (middle[..., 0] > 0).mean() < 0.02


def test_a_cloud_without_colours_is_fitted_and_grey(tmp_path: Path, context: Any, stack: PanelStack) -> None:
    points = np.random.default_rng(0).normal(size=(20_000, 3)) * 40
    picture = drawn(cloud(tmp_path / "a.ply", points), context, stack)
    seen = picture[picture[..., 3] == 255]
    assert len(seen) > 3000 and (np.ptp(seen[:, :3], axis=0) <= 1).all()


HEAD = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (HEAD.format(3) + "0 0 0\n0 1 nan\n1 0 0\n", "x, y, z: 1 of 3 are not finite"),
        (HEAD.format(3) + "0 0 0\n", "vertex"),
        (HEAD.format(0), "vertex: there are none"),
        (HEAD.format(99) + "0 0 0\n" * 99, "vertex: 99 is over the limit of 50"),
        (HEAD.format(1).replace("float z", "float w") + "0 0 0\n", "z: the property is missing"),
    ],
)
def test_a_broken_cloud_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, told: str) -> None:
    monkeypatch.setattr(LIMITS, "points", 50)
    path = tmp_path / "a.ply"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_points(read_header(path))
    assert str(refused.value).startswith(f"{path}: ") and told in str(refused.value)
