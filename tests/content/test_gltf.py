"""glTF: nodes as trimesh places them, alpha as the material says, colours times textures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.config import ContentSettings
from runtime.content.base import ContentSource
from runtime.content.mesh import load_mesh
from runtime.content.registry import open_content
from runtime.optics.stack import PanelStack
from tests.content.conftest import panel_view
from tests.content.gltf_files import SQUARE, SQUARE_FACES, Buffer

EYE = (0.6, 0.0, 0.0)


def opened(path: Path, context: Any, stack: PanelStack, **settings: Any) -> ContentSource:
    return open_content(ContentSettings(scene=str(path), **settings), stack, context)


def test_nodes_place_meshes(tmp_path: Path) -> None:
    """A child's translation counts in its parent's turned and scaled axes."""
    b = Buffer()
    primitive = {"attributes": {"POSITION": b.add(SQUARE)}, "indices": b.add(SQUARE_FACES, np.uint16)}
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1], "rotation": [0, 0, half, half], "scale": [2, 2, 2]},  # a quarter about z
        {"mesh": 0, "translation": [3, 0, 0]},
    ]
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive, nodes=nodes))
    assert data.low == pytest.approx([-2, 4, 0], abs=1e-6) and data.high == pytest.approx([2, 8, 0], abs=1e-6)


@pytest.mark.parametrize(("mode", "drawn"), [("OPAQUE", True), ("MASK", False), ("BLEND", False)])
def test_alpha_is_what_the_material_says(
    tmp_path: Path, context: Any, stack: PanelStack, mode: str, drawn: bool
) -> None:
    Image.new("RGBA", (8, 8), (255, 0, 0, 20)).save(tmp_path / "skin.png")
    b = Buffer()
    attributes = {"POSITION": b.add(SQUARE), "TEXCOORD_0": b.add([[0, 1], [1, 1], [1, 0], [0, 0]])}
    b.write(
        tmp_path / "a.gltf",
        {"attributes": attributes, "indices": b.add(SQUARE_FACES, np.uint16), "material": 0},
        images=[{"uri": "skin.png"}],
        textures=[{"source": 0}],
        materials=[{"alphaMode": mode, "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    )
    picture = opened(tmp_path / "a.gltf", context, stack).render(panel_view(EYE, stack.panel(1)), time_ns=0)
    assert bool((picture[..., 3] == 255).any()) is drawn


def test_vertex_colours_multiply_the_materials_colour(tmp_path: Path) -> None:
    b = Buffer()
    attributes = {"POSITION": b.add(SQUARE), "COLOR_0": b.add([[1.0, 0.5, 0.25]] * 4)}
    primitive = {"attributes": attributes, "indices": b.add(SQUARE_FACES, np.uint16), "material": 0}
    materials = [{"pbrMetallicRoughness": {"baseColorFactor": [0.2, 1.0, 1.0, 1.0]}}]
    (part,) = load_mesh(b.write(tmp_path / "a.gltf", primitive, materials=materials)).parts
    assert part.colour == pytest.approx((0.2, 1.0, 1.0))
    assert part.vertex_colours == pytest.approx(np.tile(np.float32([1.0, 0.5, 0.25]), (4, 1)))
