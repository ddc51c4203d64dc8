"""Which source a name opens, and what an unknown one is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from runtime.config import ContentSettings
from runtime.content.registry import open_content
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from tests.content.conftest import panel_view
from tests.content.test_splat import splat_table, written


def test_the_default_is_the_built_in_scene(context: Any, stack: PanelStack) -> None:
    assert open_content(ContentSettings(), stack, context).info.name == "demo"


def test_an_unknown_name_is_one_line_with_what_there_is(context: Any, stack: PanelStack) -> None:
    with pytest.raises(InputError, match=r"^content: scene: `nothing`.*demo"):
        open_content(ContentSettings(scene="nothing"), stack, context)


def mesh_at(folder: Path, x_m: float) -> Path:
    ball = trimesh.creation.icosphere(2, 0.01)
    ball.apply_translation([x_m, 0.0, 0.0])
    path = folder / "ball.ply"
    ball.export(path)
    return path


def splat_at(folder: Path, x_m: float) -> Path:
    table = splat_table(1, degree=0)
    for name, value in (("x", x_m), ("y", 0.0), ("z", 0.0), ("opacity", 8.0)):
        table[name] = value
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(0.004)
    return written(folder, table)


@pytest.mark.parametrize("x_m", [-0.05, 0.05])
@pytest.mark.parametrize("make", [mesh_at, splat_at])
def test_what_is_before_the_panel_lies_further_left_in_the_right_eye_s_picture(
    tmp_path: Path, context: Any, stack: PanelStack, make: Callable[[Path, float], Path], x_m: float
) -> None:
    """By -eye_y·x/(eye_x - x) of the centre plane; what is behind it the other way."""
    source = open_content(ContentSettings(scene=str(make(tmp_path, x_m)), fit=False), stack, context)
    columns = []
    for side, eye_y in enumerate((-0.03, 0.03)):
        picture = source.render(panel_view((0.6, eye_y, 0.0), stack.panel(1), side=side), time_ns=0)
        weight = picture[..., 3].astype(float).sum(0)
        columns.append(float((weight * np.arange(stack.width_px)).sum() / weight.sum()))
    expected = -0.06 * x_m / (0.6 - x_m) / (stack.width_m / stack.width_px)
    assert columns[1] - columns[0] == pytest.approx(expected, abs=0.5)
    assert abs(expected) > 4
