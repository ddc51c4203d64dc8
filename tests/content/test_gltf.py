"""Tests that glTF 2.0 files of each kind are drawn as the specification says."""

from __future__ import annotations

import base64
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.content.gltf_file import WAY_OUT
from runtime.content.mesh import load_mesh
from runtime.errors import InputError
from runtime.support.untrusted_input import LIMITS
from tests.calls import refusal
from tests.content.conftest import STACK, panel_view
from tests.content.gltf_files import SQUARE, SQUARE_FACES, Buffer

EYE = (0.6, 0.0, 0.0)
UV = [[0, 1], [1, 1], [1, 0], [0, 0]]  # the whole picture, upright
HALVES = np.array([[[255, 0, 0, 255], [0, 0, 255, 255]]], np.uint8)  # red left, blue right
FACING = [[0, 0, 1]] * 4


def uri_of(picture: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def square(b: Buffer, uv: Any = UV, **more: Any) -> dict[str, Any]:
    """A primitive of a square that faces the viewer; uv: coordinates, or an accessor's number."""
    where = uv if isinstance(uv, int) else b.add(uv)
    attributes = {"POSITION": b.add(SQUARE), "NORMAL": b.add(FACING), "TEXCOORD_0": where}
    return {"attributes": attributes, "indices": b.add(SQUARE_FACES, np.uint16), "material": 0, **more}


def painted(path: Path, b: Buffer, primitive: dict[str, Any], picture: np.ndarray = HALVES, **tables: Any) -> Path:
    """With a picture on its base colour unless the tables say otherwise."""
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "extensions": {"KHR_materials_unlit": {}}}
    own = {"materials": [base], "images": [{"uri": uri_of(picture)}], "textures": [{"source": 0, "sampler": 0}]}
    return b.write(path, primitive, **({**own, "samplers": [{"magFilter": 9728}]} | tables))


def columns(picture: np.ndarray) -> str:
    """Colours along the middle row, from left to right: r, g, b, or - for the background."""
    row = picture[picture.shape[0] // 2]
    letters = ["-" if pixel[3] < 255 else "rgb"[int(pixel[:3].argmax())] for pixel in row]
    return "".join(one for one, before in zip(letters, ["", *letters], strict=False) if one != before).strip("-")


# Geometry


def test_nodes_place_meshes(tmp_path: Path) -> None:
    """A child's translation counts in its parent's turned and scaled axes."""
    b = Buffer()
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1], "rotation": [0, 0, half, half], "scale": [2, 2, 2]},  # a quarter about z
        {"mesh": 0, "translation": [3, 0, 0]},
    ]
    data = load_mesh(b.write(tmp_path / "a.gltf", square(b), nodes=nodes, materials=[{}]))
    assert data.low == pytest.approx([-2, 4, 0], abs=1e-6) and data.high == pytest.approx([2, 8, 0], abs=1e-6)


def test_only_the_scene_is_drawn(tmp_path: Path) -> None:
    b = Buffer()
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [9, 0, 0]}]
    scenes = [{"nodes": [0]}, {"nodes": [1]}]
    data = load_mesh(b.write(tmp_path / "a.gltf", square(b), nodes=nodes, scenes=scenes, scene=1, materials=[{}]))
    assert data.low[0] == 8


@pytest.mark.parametrize(
    ("mode", "corners"),
    [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])],
    ids=["triangles", "a strip", "a fan"],
)
@pytest.mark.parametrize("indexed", [True, False])
def test_every_mode_of_triangles_is_drawn_from_its_front(
    tmp_path: Path, drawn: Any, mode: int, corners: list[int], indexed: bool
) -> None:
    """Section 3.7.2.1. The flat normals follow the winding."""
    b = Buffer()
    if indexed:
        primitive = {"attributes": {"POSITION": b.add(SQUARE)}, "indices": b.add(corners, np.uint8)}
    else:
        primitive = {"attributes": {"POSITION": b.add(np.array(SQUARE)[corners])}}
    (part,) = load_mesh(b.write(tmp_path / "a.gltf", primitive | {"mode": mode})).parts
    assert len(part.shape.triangles) == 2 and (part.shape.normals == (0, 0, 1)).all()
    side = 0.75 * STACK.height_px
    assert (drawn(tmp_path / "a.gltf")[..., 3] == 255).sum() == pytest.approx(side**2, rel=0.05)


def test_a_sparse_accessor_replaces_what_it_names(tmp_path: Path) -> None:
    """Section 3.6.2.3, with and without a separate buffer view."""
    b = Buffer()
    places, moved = b.add([3], np.uint16), b.add([[-3, 3, 0]])
    sparse = {"count": 1, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 1}}
    primitive = square(b)
    whole = primitive["attributes"]["POSITION"]
    b.accessors[whole]["sparse"] = sparse
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive, materials=[{}]))
    assert data.low.tolist() == [-3, -1, 0] and data.high.tolist() == [1, 3, 0]
    del b.accessors[whole]["bufferView"]  # zeros
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive | {"mode": 0}, materials=[{}]))
    assert data.low.tolist() == [-3, 0, 0] and data.high.tolist() == [0, 3, 0]
    assert places != moved


@pytest.mark.parametrize(("dtype", "most"), [(np.int8, 127), (np.int16, 32767), (np.uint8, 255), (np.uint16, 65535)])
@pytest.mark.parametrize("normalized", [True, False])
def test_integers_are_fractions_where_they_are_normalized(
    tmp_path: Path, dtype: Any, most: int, normalized: bool
) -> None:
    """Section 3.6.2.2; KHR_mesh_quantization."""
    b = Buffer()
    padded = np.zeros((4, 4), dtype)
    padded[:, :3] = np.maximum(SQUARE, 0) * most
    position = b.add(padded, dtype, normalized=normalized, type="VEC3")
    b.views[-1]["byteStride"] = padded.strides[0]
    primitive = {"attributes": {"POSITION": position}, "indices": b.add(SQUARE_FACES, np.uint16)}
    required = ["KHR_mesh_quantization"]
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive, extensionsRequired=required, extensionsUsed=required))
    assert data.high[0] == pytest.approx(1.0 if normalized else most) and data.left_out == ()


def test_without_normals_it_is_flat_and_with_them_as_they_say(tmp_path: Path) -> None:
    """Section 3.7.2.1: a roof's two faces share no shade."""
    b = Buffer()
    roof = b.add([[-1, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 9], [0, 1, 9], [1, 0, 9]])
    faces = b.add([0, 3, 4, 0, 4, 1, 1, 4, 5, 1, 5, 2], np.uint16)
    (flat,) = load_mesh(b.write(tmp_path / "a.gltf", {"attributes": {"POSITION": roof}, "indices": faces})).parts
    left, right = np.unique(np.round(flat.shape.normals, 3), axis=0).tolist()
    assert left == pytest.approx([-0.707, 0.707, 0]) and right == pytest.approx([0.707, 0.707, 0])
    attributes = {"POSITION": roof, "NORMAL": b.add([[0, 1, 0]] * 6)}
    (smooth,) = load_mesh(b.write(tmp_path / "a.gltf", {"attributes": attributes, "indices": faces})).parts
    assert (smooth.shape.normals == (0, 1, 0)).all()


def test_a_mirrored_node_keeps_its_front(tmp_path: Path) -> None:
    b = Buffer()
    for attributes in ({"POSITION": b.add(SQUARE)}, {"POSITION": b.add(SQUARE), "NORMAL": b.add(FACING)}):
        primitive = {"attributes": attributes, "indices": b.add(SQUARE_FACES, np.uint16)}
        data = load_mesh(b.write(tmp_path / "a.gltf", primitive, nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]))
        assert data.facing == pytest.approx([0, 0, 1]) and (data.parts[0].shape.normals == (0, 0, 1)).all()


def test_morphs_have_their_default_weights(tmp_path: Path) -> None:
    """Section 3.7.2.2: the node's weights, else the mesh's."""
    b = Buffer()
    target = {"POSITION": b.add([[0, 0, 0], [2, 0, 0], [2, 0, 0], [0, 0, 0]])}
    meshes = [{"primitives": [square(b, targets=[target])], "weights": [0.5]}]
    assert load_mesh(b.write(tmp_path / "a.gltf", {}, meshes=meshes, materials=[{}])).high[0] == 2
    nodes = [{"mesh": 0, "weights": [1.0]}]
    assert load_mesh(b.write(tmp_path / "a.gltf", {}, meshes=meshes, nodes=nodes, materials=[{}])).high[0] == 3


def test_a_skin_has_the_pose_of_its_nodes(tmp_path: Path) -> None:
    """Section 3.7.3: joints place it; the node that has it does not."""
    b = Buffer()
    primitive = square(b)
    primitive["attributes"]["JOINTS_0"] = b.add([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]], np.uint8)
    primitive["attributes"]["WEIGHTS_0"] = b.add([[255, 0, 0, 0]] * 4, np.uint8, normalized=True)
    back = np.eye(4)
    back[3, 0] = -1.0  # column by column: the second joint was bound at x = 1
    skins = [{"joints": [1, 2], "inverseBindMatrices": b.add([np.eye(4), back])}]
    nodes = [{"mesh": 0, "skin": 0, "translation": [50, 0, 0]}, {"children": [2]}, {"translation": [4, 0, 0]}]
    scenes = [{"nodes": [0, 1]}]
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive, nodes=nodes, skins=skins, scenes=scenes, materials=[{}]))
    assert data.low[0] == -1 and data.high[0] == pytest.approx(1 - 1 + 4)


def test_a_skin_may_name_more_than_four_joints_per_vertex(tmp_path: Path) -> None:
    b = Buffer()
    primitive = square(b)
    for number, joint in ((0, 0), (1, 1)):  # half of each vertex's weight is in the second set
        primitive["attributes"][f"JOINTS_{number}"] = b.add([[joint, 0, 0, 0]] * 4, np.uint8)
        primitive["attributes"][f"WEIGHTS_{number}"] = b.add([[128, 0, 0, 0]] * 4, np.uint8, normalized=True)
    skins = [{"joints": [1, 2]}]
    nodes = [{"mesh": 0, "skin": 0}, {"children": [2]}, {"translation": [4, 0, 0]}]
    scenes = [{"nodes": [0, 1]}]
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive, nodes=nodes, skins=skins, scenes=scenes, materials=[{}]))
    assert (data.low[0], data.high[0]) == (pytest.approx(-1 + 2), pytest.approx(1 + 2))


@pytest.mark.parametrize("hidden", [{"scale": [0, 0, 0]}, {"extensions": {"KHR_node_visibility": {"visible": False}}}])
def test_hidden_objects_do_not_count_in_the_fit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, hidden: dict[str, Any]
) -> None:
    """A hidden node hides its children. `visible` alone changes nothing."""
    b = Buffer()
    nodes = [
        {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": True}}},
        {"children": [2], "translation": [100, 0, 0], **hidden},
        {"mesh": 0},
    ]
    tables = {"nodes": nodes, "scenes": [{"nodes": [0, 1]}], "extensionsUsed": ["KHR_node_visibility"]}
    data = load_mesh(b.write(tmp_path / "a.gltf", square(b), materials=[{}], **tables))
    assert len(data.parts) == 1 and data.high.tolist() == [1, 1, 0] and data.left_out == ()


def test_triangles_without_area_do_not_count_in_the_fit(tmp_path: Path) -> None:
    """Such as those of a skin whose joints have a scale of 0."""
    b = Buffer()
    primitive = square(b)
    dot = primitive | {"attributes": {"POSITION": b.add([[50.0, 0, 0]] * 4)}}
    meshes = [{"primitives": [primitive, dot]}]
    data = load_mesh(b.write(tmp_path / "a.gltf", primitive, meshes=meshes, materials=[{}]))
    assert data.high.tolist() == [1, 1, 0]


@pytest.mark.parametrize("at", [1e7, 1e9])
def test_nodes_far_from_the_origin_are_centred_before_they_are_float32(tmp_path: Path, at: float) -> None:
    b = Buffer()
    nodes = [{"children": [1, 2], "translation": [at, 0, 0]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    data = load_mesh(b.write(tmp_path / "a.gltf", square(b), nodes=nodes, materials=[{}]))
    first, second = (part.shape.positions_m for part in data.parts)
    assert (second - first)[:, 0] == pytest.approx(3, abs=1e-5) and np.ptp(first, axis=0).tolist() == [2, 2, 0]
    assert data.low[0] == at - 1 and data.high[0] == at + 4


def glb(*chunks: tuple[bytes, bytes]) -> bytes:
    body = b"".join(len(data).to_bytes(4, "little") + kind + data for kind, data in chunks)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def test_a_glb_may_be_padded_with_zeros_and_have_other_chunks(tmp_path: Path) -> None:
    b = Buffer()
    text = json.dumps(b.table(square(b), materials=[{}], buffers=[{"byteLength": len(b.data)}])).encode()
    binary, other = (b"BIN\0", b.data + b"\0\0"), (b"XTRA", b"1234")
    for chunks in ((binary,), (other, binary)):
        (tmp_path / "a.glb").write_bytes(glb((b"JSON", text + b"\0" * 5), *chunks))
        assert load_mesh(tmp_path / "a.glb").high.tolist() == [1, 1, 0]
    (tmp_path / "a.glb").write_bytes(glb((b"JSON", text), other))
    with pytest.raises(InputError, match=r"buffers\[0\]\.uri: is missing"):
        load_mesh(tmp_path / "a.glb")


@pytest.mark.parametrize("uri", ["Textures/WOOD é.png", "textures\\wood e\u0301.png", "textures/wood%20%C3%A9.png"])
def test_a_texture_is_found_in_another_case_or_unicode_form(tmp_path: Path, uri: str) -> None:
    b = Buffer()
    (tmp_path / "textures").mkdir()
    Image.fromarray(HALVES).save(tmp_path / "textures" / "wood é.png")
    look = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tables = {"images": [{"uri": uri}], "textures": [{"source": 0}], "materials": look}
    (part,) = load_mesh(b.write(tmp_path / "a.gltf", square(b) | {"material": 0}, **tables)).parts
    assert part.picture is not None and part.picture.shape[:2] == HALVES.shape[:2]


def test_a_node_stands_as_often_as_its_instances_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """EXT_mesh_gpu_instancing."""
    b = Buffer()
    own = {"TRANSLATION": b.add([[0, 0, 0], [10, 0, 0], [0, 5, 0]]), "SCALE": b.add([[1, 1, 1], [2, 2, 2], [1, 1, 1]])}
    nodes = [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": own}}}]
    path = b.write(tmp_path / "a.gltf", square(b), nodes=nodes, materials=[{}])
    data = load_mesh(path)
    assert len(data.parts) == 3 and data.high[:2].tolist() == [12, 6]
    monkeypatch.setattr(LIMITS, "instances", 2)
    with pytest.raises(InputError, match="nodes: 3 exceeds the limit of 2"):
        load_mesh(path)


# Texture coordinates


@pytest.mark.parametrize(
    ("wrap", "seen"), [(10497, "rbrbrb"), (33071, "rb"), (33648, "brrbbr".replace("rr", "r").replace("bb", "b"))]
)
def test_a_sampler_says_how_a_texture_goes_on(tmp_path: Path, drawn: Any, wrap: int, seen: str) -> None:
    """From -1 to 2 across: repeated, its edge, mirrored."""
    b = Buffer()
    across = [[-1, 1], [2, 1], [2, 0], [-1, 0]]
    painted(tmp_path / "a.gltf", b, square(b, across), samplers=[{"wrapS": wrap, "wrapT": wrap, "magFilter": 9728}])
    assert columns(drawn(tmp_path / "a.gltf")) == seen


def test_a_texture_has_its_own_rule_for_each_direction(tmp_path: Path, drawn: Any) -> None:
    """From -1 to 2 both ways: the edge is repeated across, and the picture is repeated downwards."""
    b = Buffer()
    both = [[-1, 2], [2, 2], [2, -1], [-1, -1]]
    quarters = np.array([[[255, 0, 0, 255], [0, 0, 255, 255]], [[0, 255, 0, 255], [0, 0, 255, 255]]], np.uint8)
    samplers = [{"wrapS": 33071, "wrapT": 10497, "magFilter": 9728}]
    picture = drawn(painted(tmp_path / "a.gltf", b, square(b, both), quarters, samplers=samplers))
    assert columns(picture[: STACK.height_px // 2 + 10]) in ("rb", "gb")
    left = slice(STACK.width_px // 2 - 30, STACK.width_px // 2 - 10)
    assert columns(picture[:, left].transpose(1, 0, 2)[::-1]) in ("rgrgrg", "grgrgr")


def test_a_texture_takes_the_coordinates_that_it_names(tmp_path: Path, drawn: Any) -> None:
    b = Buffer()
    primitive = square(b, [[0, 0]] * 4)
    primitive["attributes"]["TEXCOORD_1"] = b.add(UV)
    materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}]
    painted(tmp_path / "a.gltf", b, primitive, materials=materials)
    assert columns(drawn(tmp_path / "a.gltf")) == "rb"


def test_texture_transforms_scale_turn_and_move(tmp_path: Path) -> None:
    """KHR_texture_transform's own example: the lower left quarter of the picture, turned clockwise by 90 degrees."""
    b = Buffer()
    own = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5], "texCoord": 1}
    materials = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": own}}}}
    ]
    primitive = square(b, [[7, 7]] * 4)
    primitive["attributes"]["TEXCOORD_1"] = b.add([[0, 0], [1, 0], [1, 1], [0, 1]])
    (part,) = load_mesh(painted(tmp_path / "a.gltf", b, primitive, materials=materials)).parts
    assert part.shape.uv == pytest.approx(np.array([[0, 1], [0, 0.5], [0.5, 0.5], [0.5, 1]]), abs=1e-6)


# Colours: factors and those of vertices are linear light, pictures are codes of sRGB (section 3.9.2)


def middle(picture: np.ndarray) -> list[int]:
    return picture[picture.shape[0] // 2, picture.shape[1] // 2].astype(int).tolist()


def code_of(light: float) -> float:
    return 255 * (12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055)


def light_of(code: float) -> float:
    return code / 255 / 12.92 if code / 255 <= 0.04045 else ((code / 255 + 0.055) / 1.055) ** 2.4


def material(**own: Any) -> list[dict[str, Any]]:
    unlit: dict[str, Any] = {"extensions": {"KHR_materials_unlit": {}}}
    return [unlit | own]


@pytest.mark.parametrize("light", [0.0, 0.002, 0.2, 0.5, 1.0])
def test_a_factor_is_linear_light(tmp_path: Path, drawn: Any, light: float) -> None:
    b = Buffer()
    materials = material(pbrMetallicRoughness={"baseColorFactor": [light, light, light, 1]})
    b.write(tmp_path / "a.gltf", square(b), materials=materials)
    assert middle(drawn(tmp_path / "a.gltf"))[0] == pytest.approx(code_of(light), abs=1)


def test_factor_picture_and_vertices_multiply_as_light(tmp_path: Path, drawn: Any) -> None:
    b = Buffer()
    primitive = square(b)
    primitive["attributes"]["COLOR_0"] = b.add([[0.5, 0.25, 1.0]] * 4)
    grey = np.full((1, 1, 4), (128, 128, 128, 255), np.uint8)
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.4, 1.0, 0.2, 1.0]}
    painted(tmp_path / "a.gltf", b, primitive, grey, materials=material(pbrMetallicRoughness=base))
    wanted = [code_of(light_of(128) * share) for share in (0.2, 0.25, 0.2)]
    assert middle(drawn(tmp_path / "a.gltf"))[:3] == pytest.approx(wanted, abs=1)


def test_the_lamp_dims_what_is_lit_alone(tmp_path: Path, drawn: Any) -> None:
    """Unlit shows the picture's own values; lit ones follow the lamp with any factors."""
    grey = np.full((1, 1, 4), (200, 200, 200, 255), np.uint8)
    base = {"baseColorTexture": {"index": 0}}
    seen = []
    for own in (material(pbrMetallicRoughness=base), [{"pbrMetallicRoughness": base}]):
        b = Buffer()
        painted(tmp_path / "a.gltf", b, square(b), grey, materials=own)
        seen.append(middle(drawn(tmp_path / "a.gltf"))[0])
    assert seen[0] == 200
    b = Buffer()
    primitive = square(b)
    primitive["attributes"]["COLOR_0"] = b.add([[1.0, 1.0, 1.0]] * 4)  # the same, worked out as light
    painted(tmp_path / "a.gltf", b, primitive, grey, materials=[{"pbrMetallicRoughness": base}])
    assert 130 < seen[1] < 195 and middle(drawn(tmp_path / "a.gltf"))[0] == pytest.approx(seen[1], abs=2)


@pytest.mark.parametrize("pictured", [True, False])
def test_what_glows_adds_its_light(tmp_path: Path, drawn: Any, pictured: bool) -> None:
    """Section 3.9.3, with KHR_materials_emissive_strength."""
    own = {
        "emissiveFactor": [0.1, 0.2, 0.0],
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2.0}},
    } | ({"emissiveTexture": {"index": 0}} if pictured else {})
    b = Buffer()
    grey = np.full((1, 1, 4), (128, 128, 128, 255), np.uint8)
    painted(tmp_path / "a.gltf", b, square(b), grey, materials=[own])
    share = light_of(128) if pictured else 1.0
    wanted = [code_of(0.2 * share), code_of(0.4 * share), 0]
    assert middle(drawn(tmp_path / "a.gltf"))[:3] == pytest.approx(wanted, abs=1)


def test_specular_glossiness_has_a_diffuse_palette(tmp_path: Path, drawn: Any) -> None:
    b = Buffer()
    file = io.BytesIO()
    Image.fromarray(HALVES[..., :3]).convert("P").save(file, "PNG")
    own = {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}}
    images = [{"uri": "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()}]
    required = {"extensionsRequired": [*own], "extensionsUsed": [*own]}
    painted(tmp_path / "a.gltf", b, square(b), materials=[{"extensions": own}], images=images, **required)
    assert columns(drawn(tmp_path / "a.gltf")) == "rb"


# Alpha (section 3.9.4)


@pytest.mark.parametrize("place", ["texture", "factor", "vertices"])
@pytest.mark.parametrize(
    ("mode", "alpha", "covers"),
    [("OPAQUE", 0.1, 1.0), ("MASK", 0.3, 0.0), ("MASK", 0.6, 1.0), ("BLEND", 0.3, 0.3), ("BLEND", 1.0, 1.0)],
)
def test_alpha_is_what_the_material_says(
    tmp_path: Path, drawn: Any, place: str, mode: str, alpha: float, covers: float
) -> None:
    b = Buffer()
    primitive, white = square(b), np.full((1, 1, 4), 255, np.uint8)
    base: dict[str, Any] = {"baseColorTexture": {"index": 0}}
    if place == "texture":
        white[..., 3] = round(255 * alpha)
    elif place == "factor":
        base |= {"baseColorFactor": [1, 1, 1, alpha]}
    else:
        primitive["attributes"]["COLOR_0"] = b.add([[1, 1, 1, alpha]] * 4)
    painted(tmp_path / "a.gltf", b, primitive, white, materials=material(alphaMode=mode, pbrMetallicRoughness=base))
    seen = middle(drawn(tmp_path / "a.gltf", background=(0.0, 0.0, 0.0)))
    assert seen[0] == pytest.approx(255 * covers, abs=2) and (seen[3] > 0) is (covers > 0)


def test_what_is_behind_glass_shows_through_it_whatever_the_order(tmp_path: Path, drawn: Any) -> None:
    b = Buffer()
    primitives = [square(b) | {"material": number} for number in (0, 1)]
    glass = {"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 0.5]}}
    materials = [*material(**glass), *material(pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]})]
    meshes = [{"primitives": [primitive]} for primitive in primitives]
    for nodes in ([0, 1], [1, 0]):
        placed = [{"mesh": mesh, "translation": [0, 0, 0.2 if mesh == 0 else -0.2]} for mesh in nodes]
        b.write(tmp_path / "a.gltf", {}, meshes=meshes, nodes=placed, scenes=[{"nodes": [0, 1]}], materials=materials)
        assert middle(drawn(tmp_path / "a.gltf")) == pytest.approx([128, 0, 128, 255], abs=2)


def test_a_front_alone_is_seen_through_unless_it_has_two_sides(tmp_path: Path, drawn: Any) -> None:
    """A closed glass box has one visible layer, or two."""
    b = Buffer()
    near, far = np.add(SQUARE, [0, 0, 0.5]), np.subtract(SQUARE, [0, 0, 0.5])[::-1]
    attributes = {"POSITION": b.add([*near, *far]), "NORMAL": b.add([[0, 0, 1]] * 4 + [[0, 0, -1]] * 4)}
    faces = b.add([*SQUARE_FACES, *(index + 4 for index in SQUARE_FACES)], np.uint16)
    primitive = {"attributes": attributes, "indices": faces, "material": 0}
    for two_sided, covers in ((False, 0.5), (True, 0.75)):
        glass = {"alphaMode": "BLEND", "doubleSided": two_sided}
        own = material(**glass, pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.5]})
        b.write(tmp_path / "a.gltf", primitive, materials=own)
        seen = middle(drawn(tmp_path / "a.gltf", background=(0.0, 0.0, 0.0)))
        assert seen[0] == pytest.approx(255 * covers, abs=3)


# Parts, and skipped contents


@pytest.mark.parametrize("pictured", [False, True])
def test_parts_that_look_alike_are_drawn_as_one(tmp_path: Path, opened: Any, pictured: bool) -> None:
    """A hundred colours are one part, and still a hundred colours."""
    random = np.random.default_rng(0)
    b = Buffer()
    primitives = [square(b) | {"material": number} for number in range(100)]
    colours = random.uniform(size=(100, 3)).tolist()
    use = {"baseColorTexture": {"index": 0}} if pictured else {}
    materials = [{"pbrMetallicRoughness": {"baseColorFactor": [*colour, 1], **use}} for colour in colours]
    white = {"images": [{"uri": uri_of(np.full((1, 1, 4), 255, np.uint8))}], "textures": [{"source": 0}]}
    nodes = [{"mesh": k, "translation": [3 * (k % 10), 3 * (k // 10), 0]} for k in range(100)]
    meshes = [{"primitives": [primitive]} for primitive in primitives]
    scenes = [{"nodes": [*range(100)]}]
    path = b.write(tmp_path / "a.gltf", {}, meshes=meshes, nodes=nodes, scenes=scenes, materials=materials, **white)
    source = opened(path)
    assert len(load_mesh(path).parts) == 100 and len(source.parts) == 1
    one = source.render(panel_view(EYE, STACK.panel(1)), time_ns=0)
    lit = one[one[..., 3] == 255][:, :3].astype(int)
    assert len(np.unique(lit, axis=0)) >= 100


def test_what_is_not_drawn_is_said_once_and_in_the_info(
    tmp_path: Path, opened: Any, caplog: pytest.LogCaptureFixture
) -> None:
    b = Buffer()
    lines = {"attributes": {"POSITION": b.add(SQUARE)}, "mode": 1}
    tables = {"animations": [{}], "extensionsUsed": ["KHR_materials_transmission", "KHR_texture_transform"]}
    path = b.write(tmp_path / "a.gltf", {}, meshes=[{"primitives": [square(b), lines]}], materials=[{}], **tables)
    source = opened(path)
    assert source.info.left_out == ("KHR_materials_transmission", "animations", "points and lines")
    assert f"{path}: not drawing KHR_materials_transmission, animations, points and lines" in caplog.messages


def compressed(path: Path, *, required: bool, fallback: bool) -> Path:
    """A square that Draco has compressed."""
    DracoPy = pytest.importorskip("DracoPy")
    b = Buffer()
    primitive = square(b)
    data = DracoPy.encode(np.array(SQUARE, np.float32), np.array(SQUARE_FACES, np.uint32).reshape(-1, 3))
    number = DracoPy.decode(data).attributes[0]["unique_id"]
    view = b.accessors[b.add(np.frombuffer(data, np.uint8), np.uint8)]["bufferView"]
    own = {"bufferView": view, "attributes": {"POSITION": number}}
    primitive |= {"extensions": {"KHR_draco_mesh_compression": own}}
    del primitive["attributes"]["NORMAL"], primitive["attributes"]["TEXCOORD_0"]
    if not fallback:
        for accessor in (primitive["attributes"]["POSITION"], primitive["indices"]):
            del b.accessors[accessor]["bufferView"]
    names = ["KHR_draco_mesh_compression"]
    return b.write(path, primitive, materials=[{}], extensionsUsed=names, extensionsRequired=names if required else [])


def test_draco_is_decoded(tmp_path: Path) -> None:
    path = compressed(tmp_path / "a.gltf", required=True, fallback=False)
    data = load_mesh(path)
    assert len(data.parts[0].shape.triangles) == 2 and data.left_out == ()
    assert data.low == pytest.approx([-1, -1, 0], abs=1e-3) and data.high == pytest.approx([1, 1, 0], abs=1e-3)
    table = json.loads(path.read_text())
    path.write_text(json.dumps(table | {"buffers": [{"uri": "0.bin", "byteLength": 9}]}))
    with pytest.raises(InputError, match=r"KHR_draco_mesh_compression: 0\.bin does not exist"):
        load_mesh(path)


def test_without_its_decoder_draco_is_named_unless_there_is_another_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone, both = (compressed(tmp_path / f"{has}.gltf", required=False, fallback=has) for has in (False, True))
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    assert refusal(load_mesh, alone).endswith(
        f"reading Draco requires `pip install 'phasestack[draco]'`; otherwise {WAY_OUT}"
    )
    assert load_mesh(both).high.tolist() == [1, 1, 0]


def test_of_a_pictures_two_forms_the_known_one_is_read(tmp_path: Path, drawn: Any) -> None:
    b = Buffer()
    textures = [{"source": 1, "extensions": {"KHR_texture_basisu": {"source": 0}}, "sampler": 0}]
    images = [{"uri": "data:image/ktx2;base64,AAAA"}, {"uri": uri_of(HALVES)}]
    painted(tmp_path / "a.gltf", b, square(b), textures=textures, images=images)
    assert columns(drawn(tmp_path / "a.gltf")) == "rb"
