"""glTF: what moves (nodes, bones), materials as OBJ has them, and what a hostile file is told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentSource
from runtime.content.camera import project
from runtime.content.mesh import load_mesh
from runtime.content.registry import open_content
from runtime.content.rig import Channel, slerp
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from tests.content.conftest import panel_view
from tests.content.gltf_files import SQUARE, SQUARE_FACES, Buffer, bending_bar, moving_square

EYE = (0.6, 0.0, 0.0)


def opened(path: Path, context: Any, stack: PanelStack, **settings: Any) -> ContentSource:
    return open_content(ContentSettings(scene=str(path), **settings), stack, context)


def columns_at(source: ContentSource, stack: PanelStack, time_s: float) -> float:
    """The middle column of what is drawn."""
    picture = source.render(panel_view(EYE, stack.panel(1)), time_ns=round(time_s * NS_PER_S))
    return float(np.nonzero(picture[..., 3] == 255)[1].mean() + 0.5)


def test_a_node_goes_where_its_keys_say_and_begins_again(tmp_path: Path, context: Any, stack: PanelStack) -> None:
    source = opened(moving_square(tmp_path / "a.gltf"), context, stack)
    assert source.info.moving and source.revision(time_ns=5) == 5
    left, middle, right = (columns_at(source, stack, time) for time in (0.0, 1.0, 1.999))
    assert middle == pytest.approx(stack.width_px / 2, abs=1)
    assert right - middle == pytest.approx(middle - left, abs=1)
    assert columns_at(source, stack, 0.5) == pytest.approx((left + middle) / 2, abs=1)
    assert columns_at(source, stack, 4.5) == columns_at(source, stack, 0.5)
    # It is fitted for the whole of its way: nothing of it ever leaves the display.
    assert left > stack.width_px * 0.05 and right < stack.width_px * 0.95


def test_an_animation_can_be_chosen_or_left_out(tmp_path: Path, context: Any, stack: PanelStack) -> None:
    path = moving_square(tmp_path / "a.gltf")
    assert not opened(path, context, stack, animation="none").info.moving
    assert opened(path, context, stack, animation="slide").info.moving
    assert opened(path, context, stack, animation="0").info.moving
    with pytest.raises(InputError, match=r"content: animation: 'jump' is none of the 1 of the file: slide"):
        opened(path, context, stack, animation="jump")


def test_steps_and_splines(tmp_path: Path, context: Any, stack: PanelStack) -> None:
    steps = opened(moving_square(tmp_path / "a.gltf", kind="STEP"), context, stack)
    assert columns_at(steps, stack, 1.9) == columns_at(steps, stack, 0.0)
    spline = load_mesh(moving_square(tmp_path / "b.gltf", kind="CUBICSPLINE")).rig
    # Tangents of 0: Hermite's 3s^2 - 2s^3.
    assert spline.channels[0].at(0.5)[0] == pytest.approx(-3 + 6 * (3 * 0.25**2 - 2 * 0.25**3))


def test_turns_are_interpolated_as_scipy_does() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        ends = Rotation.random(2, random_state=int(rng.integers(1 << 30)))
        between = Slerp([0, 1], ends)(0.3)
        mine = Rotation.from_quat(slerp(ends[0].as_quat(), -ends[1].as_quat(), 0.3))
        assert (mine * between.inv()).magnitude() < 1e-9
    channel = Channel(0, "rotation", "LINEAR", np.array([0.0, 1.0]), np.zeros((2, 1, 4)))
    assert np.isfinite(channel.at(0.5)).all() and np.isfinite(channel.at(7.0)).all()


def test_bones_carry_their_vertices(tmp_path: Path) -> None:
    data = load_mesh(bending_bar(tmp_path / "a.gltf"))
    rest, bent = (data.rig.posed([data.parts[0].shape], time)[0][0].positions_m for time in (0.0, 1.0))
    assert np.abs(rest - data.parts[0].shape.positions_m).max() < 1e-6
    tip = np.abs(rest[:, 1] - 4) < 1e-6
    # Turned by 90 degrees about z at (0, 2, 0): (x, y) goes to (2 - y, 2 + x).
    expected = np.column_stack([2 - rest[tip, 1], 2 + rest[tip, 0], rest[tip, 2]])
    assert np.abs(bent[tip] - expected).max() < 1e-5
    assert np.abs(bent[rest[:, 1] < 1.4] - rest[rest[:, 1] < 1.4]).max() < 1e-6


def test_a_bent_model_is_drawn_where_its_vertices_are(tmp_path: Path, context: Any, stack: PanelStack) -> None:
    path = bending_bar(tmp_path / "a.gltf")
    source = opened(path, context, stack, fit=False, scale=0.02)
    picture = source.render(panel_view(EYE, stack.panel(1)), time_ns=NS_PER_S - 1)
    rows, columns = np.nonzero(picture[..., 3] == 255)
    view = panel_view(EYE, stack.panel(1))
    # Without fitting glTF's x is the stack's y, its y the stack's z; the tip is at (-2, 2).
    tip = project(view.pixels_from_stack, np.array([[0.0, -0.04, 0.04]]))[0][0]
    assert columns.min() == pytest.approx(tip[0], abs=2)
    assert np.abs(rows[columns < columns.min() + 3].mean() - tip[1]) < 3


def test_a_still_scene_is_as_the_mesh_library_reads_it(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    box = trimesh.creation.box((1, 2, 3))
    for number in range(3):
        turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(number).random(3))
        turn[:3, 3] = (number, 2 * number, 0)
        scene.add_geometry(box, transform=turn @ np.diag([1.0, -0.5 * number - 1, 1.0, 1.0]))
    path = tmp_path / "a.glb"
    scene.export(path)
    data = load_mesh(path)
    mine = []
    for shape, matrix in data.rig.posed([part.shape for part in data.parts], 0.0):
        corners = (shape.positions_m @ matrix[:3, :3].T + matrix[:3, 3])[shape.triangles]
        mine.append(corners if np.linalg.det(matrix[:3, :3]) > 0 else corners[:, [0, 2, 1]])
    assert np.abs(faces_of(mine) - faces_of([mesh.triangles for mesh in trimesh.load_scene(path).dump()])).max() < 1e-4


def faces_of(corners: list[np.ndarray]) -> np.ndarray:
    """Middles and normals of triangles, whichever corner each begins with, in an order of their own."""
    triangles = np.concatenate(corners).astype(float)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    rows = np.column_stack([triangles.mean(1), normals])
    return rows[np.lexsort(np.rint(rows.T * 1000))]


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


def changed(path: Path, change: Any) -> Path:
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    return path


def many_bones(table: dict[str, Any]) -> None:
    table["skins"][0]["joints"] = [1] * 100_000


def many_nodes(table: dict[str, Any]) -> None:
    table["nodes"] += [{}] * 20_000


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (many_bones, "nodes and bones: 100,003 is over the limit of 5,000"),
        (many_nodes, "nodes and bones: 20,005 is over the limit of 5,000"),
        (lambda t: t["skins"][0].update(joints=[1]), "JOINTS_0 names bones beyond the 1 there are"),
        (lambda t: t["nodes"][1].update(rotation=[0, 0, 1]), "[0, 0, 1] must be 4 numbers"),
        (lambda t: t["nodes"][1].update(scale=[1e99, 0, 1]), "must be 3 numbers"),
        (lambda t: t["accessors"][0].update(type="VEC4"), "accessors[0] is VEC4, not VEC3"),
        (lambda t: t["meshes"][0]["primitives"][0].update(mode=5), "mode: strips and fans of triangles are not read"),
    ],
)
def test_a_hostile_rig_is_one_line_that_names_the_field(tmp_path: Path, change: Any, told: str) -> None:
    path = changed(bending_bar(tmp_path / "a.gltf"), change)
    with pytest.raises(InputError) as refused:
        load_mesh(path)
    assert str(refused.value).startswith(f"{path}: ") and told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_model_that_its_animation_throws_out_of_the_world_is_refused(tmp_path: Path) -> None:
    path = moving_square(tmp_path / "a.gltf")
    path = changed(path, lambda table: table["nodes"].append({"children": [0], "scale": [1e15, 1e15, 1e15]}))
    path = changed(path, lambda table: table["scenes"][0].update(nodes=[1]))
    with pytest.raises(InputError, match=r"a.gltf: nodes: place vertices beyond"):
        load_mesh(path)
