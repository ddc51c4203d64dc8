"""Tests that a closed source leaves no GL object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
import trimesh

from runtime.config import ContentSettings
from runtime.content.registry import prepare_content
from tests.content.conftest import STACK, panel_view
from tests.content.test_splat import splat_table, written

MAKERS = ("buffer", "texture", "vertex_array", "program", "framebuffer", "renderbuffer", "depth_renderbuffer")


class Counting:
    """A context that remembers every object that it made."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self.made: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._context, name)
        if name not in MAKERS:
            return found

        def make(*arguments: Any, **keywords: Any) -> Any:
            self.made.append(found(*arguments, **keywords))
            return self.made[-1]

        return make

    @property
    def left(self) -> list[Any]:
        """GL objects that were not released."""
        return [item for item in self.made if not isinstance(item.mglo, moderngl.InvalidObject)]


def scene_of(kind: str, folder: Path) -> str:
    match kind:
        case "mesh":
            path = folder / "ball.glb"
            trimesh.creation.icosphere(subdivisions=2).export(path)
            return str(path)
        case "splats":
            return str(written(folder, splat_table(50)))
    return kind


@pytest.mark.parametrize("kind", ["moving", "mesh", "splats"])
def test_a_closed_source_has_released_every_object_that_it_made(context: Any, tmp_path: Path, kind: str) -> None:
    counting = Counting(context)
    source = prepare_content(ContentSettings(scene=scene_of(kind, tmp_path)), STACK)(context=counting)
    for side, y_m in enumerate((-0.03, 0.03)):
        source.render(panel_view(np.array([0.7, y_m, 0.0]), STACK.panel(1), side), time_ns=0)
    assert len(counting.left) > 2
    source.close()
    source.close()
    assert counting.left == []
