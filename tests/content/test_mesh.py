"""Tests that meshes are placed, coloured and textured, and that broken files are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from runtime.config import ContentSettings
from runtime.content import mesh
from runtime.content.camera import pixels_and_depths
from runtime.content.mesh import load_mesh, prepare
from runtime.content.parts import UNCOLOURED
from runtime.content.placing import SceneFile, guessed_axes
from runtime.content.triangles import TriangleSource
from runtime.support.untrusted_input import LIMITS
from tests.calls import refusal
from tests.content.conftest import STACK, panel_view
from tests.content.gltf_files import Buffer

EYE = (0.7, 0.05, 0.1)


def textured_quad(folder: Path, suffix: str) -> Path:
    """A square that faces +z with y up, its picture red above, green below left, blue below right."""
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32] = (255, 0, 0)
    picture[32:, :32] = (0, 255, 0)
    picture[32:, 32:] = (0, 0, 255)
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    if suffix == ".obj":
        material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    path = folder / f"quad{suffix}"
    mesh.export(path)
    return path


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_picture_is_upright_and_not_mirrored(tmp_path: Path, drawn: Any, suffix: str) -> None:
    picture = drawn(textured_quad(tmp_path, suffix), (0.7, 0.0, 0.0))
    rows, columns = np.nonzero(picture[..., 3] == 255)
    top, bottom = rows.min() + 20, rows.max() - 20
    left, right = columns.min() + 20, columns.max() - 20
    assert picture[top, left].argmax() in (0, 3)
    assert picture[top, left, :3].argmax() == 0
    assert picture[top, right, :3].argmax() == 0
    assert picture[bottom, left, :3].argmax() == 1
    assert picture[bottom, right, :3].argmax() == 2


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
def test_vertex_colours_are_kept(tmp_path: Path, drawn: Any, suffix: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.visual.vertex_colors = np.tile([20, 200, 60, 255], (len(ball.vertices), 1))
    path = tmp_path / f"ball{suffix}"
    ball.export(path)
    picture = drawn(path, EYE)
    seen = picture[picture[..., 3] == 255][:, :3].astype(float)
    assert len(seen) > 1000
    # By custom they are codes; by glTF's text linear light.
    red, blue = (0.346, 0.577) if suffix == ".glb" else (0.1, 0.3)
    assert np.median(seen[:, 0] / seen[:, 1]) == pytest.approx(red, abs=0.03)
    assert np.median(seen[:, 2] / seen[:, 1]) == pytest.approx(blue, abs=0.03)


def test_a_vertex_lands_where_the_projection_says(tmp_path: Path, drawn: Any) -> None:
    tip = np.array([[0.05, 0.1, 0.06]])
    cone = trimesh.Trimesh(
        [*tip, [0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]], [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    )
    path = tmp_path / "cone.ply"
    cone.export(path)
    view = panel_view((0.6, 0.0, 0.0), STACK.panel(1))
    picture = drawn(path, fit=False)
    expected = pixels_and_depths(view.pixels_from_stack, tip)[0][0]
    rows, columns = np.nonzero(picture[..., 3] > 0)
    farthest = columns.argmax()
    assert np.hypot(columns[farthest] + 0.5 - expected[0], rows[farthest] + 0.5 - expected[1]) < 2.5


def depth_of(source: TriangleSource) -> tuple[float, float]:
    """Its rearmost and its foremost vertex, metres along x."""
    (part,), (matrix,) = source.parts, source.stack_from_parts
    x_m = part.positions @ matrix[0, :3] + matrix[0, 3]
    return float(x_m.min()), float(x_m.max())


def test_a_fitted_mesh_fills_the_display_or_its_depth(tmp_path: Path, opened: Any) -> None:
    path = tmp_path / "box.glb"
    trimesh.creation.box((100.0, 20.0, 30.0)).export(path)
    rear, front = depth_of(opened(path, depth_m=(-0.3, 0.3)))
    assert front == pytest.approx(-rear)
    assert front - rear == pytest.approx(30 * 0.75 * STACK.width_m / 100, rel=1e-3)
    # A shallow depth range starts at the front and may reach twice as deep.
    rear, front = depth_of(opened(path, depth_m=(-0.01, 0.03)))
    assert (rear, front) == pytest.approx((-0.05, 0.03), abs=1e-4)


@pytest.mark.parametrize(
    ("low", "high", "axes"),
    [
        ((-0.036, -0.037, 0.004), (0.036, 0.037, 0.219), ("+z", "-y")),  # a bottle with its base at z = 0
        ((-0.095, 0.033, -0.062), (0.061, 0.186, 0.059), ("+y", "+z")),  # a rabbit above y = 0
        ((-0.266, -0.332, -0.263), (0.266, 0.332, 0.264), ("+y", "+z")),  # a chair around the origin: its longer axis
    ],
)
def test_the_axes_of_a_file_are_guessed_from_its_extent(
    low: tuple[float, ...], high: tuple[float, ...], axes: tuple[str, str]
) -> None:
    assert guessed_axes(np.array(low), np.array(high)) == axes


CARD = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]  # in the plane of two axes; the third is where it looks


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl", ".ply"])
@pytest.mark.parametrize("turns", [(0, 1, 2), (0, -2, 1), (0, 2, -1), (2, 1, -0.0), (-2, 1, 0), (-0.0, 1, -2)])
def test_what_is_flat_shows_its_front(tmp_path: Path, opened: Any, suffix: str, turns: tuple[float, ...]) -> None:
    """A card of any orientation in its file fills the display's height with its front."""
    columns = [np.array(CARD)[:, abs(int(axis))] * (-1 if np.signbit(axis) else 1) for axis in turns]
    trimesh.Trimesh(np.column_stack(columns), [[0, 1, 2], [0, 2, 3]], process=False).export(tmp_path / f"a{suffix}")
    source = opened(tmp_path / f"a{suffix}")
    picture = source.render(panel_view((0.7, 0.0, 0.0), STACK.panel(1)), time_ns=0)
    assert (picture[..., 3] == 255).sum() > 0.9 * (0.75 * STACK.height_px) ** 2
    normals = source.parts[0].vertices[:, 3:6] @ source.stack_from_parts[0][:3, :3].T
    assert (normals[:, 0] > 0).all()


@pytest.mark.parametrize(("suffix", "up"), [(".glb", "y"), (".obj", "y"), (".stl", "z")])
def test_up_is_what_the_format_has_by_custom(tmp_path: Path, drawn: Any, suffix: str, up: str) -> None:
    """A pole along the file's up axis is upright at any offset."""
    pole = trimesh.creation.box((1, 5, 1) if up == "y" else (1, 1, 5))
    pole.export(tmp_path / f"a{suffix}")
    picture = drawn(tmp_path / f"a{suffix}", EYE)
    rows, columns = np.nonzero(picture[..., 3])
    assert np.ptp(rows) > 3 * np.ptp(columns)


def bottle(folder: Path, suffix: str) -> Path:
    """A bottle on z = 0 with a picture around it, as others' files have one: red below, green above."""
    body = trimesh.creation.cylinder(0.036, 0.215, sections=24)
    body.apply_translation([0, 0, 0.1075])
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32], picture[32:] = (40, 200, 60), (220, 40, 40)
    uv = np.column_stack([np.arctan2(*body.vertices[:, :2].T) / 6.3 + 0.5, body.vertices[:, 2] / 0.215])
    image = Image.fromarray(picture)
    if suffix == ".obj":
        material = trimesh.visual.material.SimpleMaterial(image=image, diffuse=[255, 255, 255, 255])
        body.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        body.export(folder / "bottle.obj")
    else:
        image.save(folder / "skin.png")
        rows = [f"{x} {y} {z} {s} {t}" for (x, y, z), (s, t) in zip(body.vertices, uv, strict=True)]
        faces = [f"3 {a} {b} {c}" for a, b, c in body.faces]
        head = f"ply\nformat ascii 1.0\ncomment TextureFile skin.png\nelement vertex {len(rows)}\n"
        head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "s", "t"))
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        (folder / "bottle.ply").write_text(head + "\n".join(rows + faces) + "\n")
    return folder / f"bottle{suffix}"


def test_the_same_bottle_from_obj_and_ply_is_alike_and_stands(tmp_path: Path, drawn: Any) -> None:
    pictures = [drawn(bottle(tmp_path, suffix), EYE, axes="+z -y").astype(int) for suffix in (".obj", ".ply")]
    assert np.abs(pictures[0] - pictures[1]).max() <= 2
    rows, columns = np.nonzero(pictures[0][..., 3] == 255)
    assert np.ptp(rows) > 0.7 * STACK.height_px and np.ptp(rows) > 2 * np.ptp(columns)
    middle = int(columns.mean())
    assert (
        pictures[0][rows.min() + 20, middle, :3].argmax() == 1
        and pictures[0][rows.max() - 20, middle, :3].argmax() == 0
    )


def test_an_obj_without_its_materials_is_grey_and_a_line_says_so(
    tmp_path: Path, drawn: Any, caplog: pytest.LogCaptureFixture
) -> None:
    path = textured_quad(tmp_path, ".obj")
    for beside in [*tmp_path.glob("*.mtl"), *tmp_path.glob("*.png")]:
        beside.unlink()
    picture = drawn(path, EYE)
    seen = picture[picture[..., 3] == 255][:, :3].astype(int)
    assert len(seen) > 1000 and np.ptp(seen, axis=1).max() < 30
    assert f"{path}: drawing the mesh in grey without its materials because " in caplog.text


def with_material(folder: Path, lines: str) -> Path:
    corners = TRIANGLE + "vt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
    (folder / "a.mtl").write_text(f"newmtl a\n{lines}\n")
    (folder / "a.obj").write_text("mtllib a.mtl\n" + corners)
    return folder / "a.obj"


@pytest.mark.parametrize(
    "name",
    [
        ".\\Maps\\Skin.PNG", "maps/skin.png", "C:\\Users\\me\\Skin.png", "-s 1 1 1 Maps/Skin.png",
        "-clamp on -mm 0 1.5 -bm 1.0 -o 0.1 .\\maps\\SKIN.PNG", "-colorspace sRGB -type sphere Maps/Skin.png",
        "-s 1 1 1 Maps/1 linear\\ skin.png", "Maps/1 linear skin.png",
    ],
)  # fmt: skip
def test_a_texture_is_found_as_windows_and_exporters_write_it(tmp_path: Path, name: str) -> None:
    folder = tmp_path if ":" in name else tmp_path / "Maps"
    folder.mkdir(exist_ok=True)
    Image.new("RGB", (4, 4), (255, 0, 0)).save(folder / ("1 linear skin.png" if "linear" in name else "Skin.png"))
    (part,) = load_mesh(with_material(tmp_path, f"map_Kd {name}")).parts
    assert part.picture[0, 0].tolist() == [255, 0, 0, 255]


def test_a_missing_texture_is_grey_and_a_line_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (part,) = load_mesh(with_material(tmp_path, "map_Kd gone.png")).parts
    assert np.ptp(part.picture[0, 0, :3].astype(int)) < 30
    assert (
        f"{tmp_path / 'a.obj'}: drawing the mesh in grey without its texture because gone.png does not exist"
        in caplog.text
    )


@pytest.mark.parametrize(("line", "opacity"), [("d 0.2", 0.2), ("Tr 0.8", 0.2), ("d 1", 1.0), ("d x", 1.0), ("", 1.0)])
def test_an_mtl_says_how_opaque_it_is(tmp_path: Path, line: str, opacity: float) -> None:
    (part,) = load_mesh(with_material(tmp_path, f"Kd 1 0 0\n{line}")).parts
    assert part.opacity == pytest.approx(opacity) and part.colour == (1.0, 0.0, 0.0)
    assert ("BLEND" in part.features) is (opacity < 1)


@pytest.mark.parametrize("code", ["latin-1", "utf-16", "utf-16-le", "utf-16-be"])
def test_an_obj_in_another_encoding_is_read(tmp_path: Path, code: str) -> None:
    mark = "\ufeff".encode(code) if code[-2:] in ("le", "be") else b""
    (tmp_path / "a.obj").write_bytes(mark + ("# café\n" + TRIANGLE + "f 1 2 3\n").encode(code))
    assert len(load_mesh(tmp_path / "a.obj").parts) == 1


@pytest.mark.parametrize(("most", "outlined"), [(24, True), (23, False)])
def test_a_file_of_many_triangles_is_drawn_without_outlines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, outlined: bool
) -> None:
    """All parts count: a million triangles in five took 2.3 GB and 4.6 s a picture."""
    monkeypatch.setattr(mesh, "OUTLINED_MAX", most)
    lit, unlit = trimesh.creation.box(), trimesh.creation.box()
    lit.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(alphaMode="MASK"))
    trimesh.Scene([lit, unlit]).export(tmp_path / "a.glb")
    parts = prepare(SceneFile(tmp_path / "a.glb", ContentSettings(), STACK)).args[0]
    assert len(parts) == 2 and all((part.edges is not None) == outlined for part in parts)


def test_a_ply_with_coordinates_of_no_texture_is_as_one_without(tmp_path: Path) -> None:
    path = bottle(tmp_path, ".ply")
    path.write_text(path.read_text().replace("comment TextureFile skin.png\n", ""))
    (part,) = load_mesh(path).parts
    assert part.picture is None and part.colour == UNCOLOURED


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".gltf"])
def test_points_are_drawn_in_their_colours(tmp_path: Path, drawn: Any, suffix: str) -> None:
    places = np.stack(np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40)), -1).reshape(-1, 2)
    places = np.column_stack([places, 0 * places[:, 0]])
    path = tmp_path / f"a{suffix}"
    if suffix == ".ply":
        trimesh.PointCloud(places, np.tile([220, 40, 40, 255], (len(places), 1)).astype(np.uint8)).export(path)
    elif suffix == ".obj":
        path.write_text("".join(f"v {x} {y} {z} 0.86 0.16 0.16\n" for x, y, z in places))
    else:
        b = Buffer()
        colours = np.tile([0.71, 0.02, 0.02], (len(places), 1))  # linear
        b.write(path, {"attributes": {"POSITION": b.add(places), "COLOR_0": b.add(colours)}, "mode": 0})
    picture = drawn(path, (0.7, 0.0, 0.0), axes="+y +z")
    seen = picture[60:200, 180:300]
    assert seen[..., 3].min() > 100
    assert np.median(seen[..., 0]) > 150 and np.median(seen[..., 1]) < 80


@pytest.mark.parametrize("form", ["obj", 1, 2, 3])
def test_lines_alone_are_drawn(tmp_path: Path, drawn: Any, form: Any) -> None:
    """A square's outline: its edges are seen, its middle is not."""
    path = tmp_path / ("a.obj" if form == "obj" else "a.gltf")
    if form == "obj":
        path.write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nl 1 2 3 4/1\nl -1 1\n")
    else:
        b = Buffer()
        corners = {1: [0, 1, 1, 2, 2, 3, 3, 0], 2: [0, 1, 2, 3], 3: [0, 1, 2, 3, 0]}[form]
        b.write(path, {"attributes": {"POSITION": b.add(CARD)}, "indices": b.add(corners, np.uint8), "mode": form})
    covered = drawn(path, (0.7, 0, 0))[..., 3]
    rows, columns = np.nonzero(covered > 128)
    side = 0.75 * STACK.height_px
    assert np.ptp(rows) == pytest.approx(side, abs=8) and np.ptp(columns) == pytest.approx(side, abs=8)
    assert covered[135, 240] == 0 and (covered[rows.min() : rows.max(), columns.min() + 1] > 128).mean() > 0.95


STRIPS = "ply\nformat ascii 1.0\nWritten by somebody\nelement vertex 3\nproperty float x\nproperty float y\n"
STRIPS += "property float z\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
COLOURED = "COFF\n3 1 0\n0 0 0 255 0 0 255\n1 0 0 0 255 0 255\n0 1 0 0 0 255 255\n3 0 1 2\n"


@pytest.mark.parametrize(
    ("name", "text", "left_out"),
    [("a.off", COLOURED, "colours"), ("a.ply", STRIPS + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "tristrips")],
)
def test_what_a_mesh_file_has_besides_is_said_to_be_left_out(
    tmp_path: Path, name: str, text: str, left_out: str
) -> None:
    (tmp_path / name).write_text(text)
    assert load_mesh(tmp_path / name).left_out == (left_out,)


CLOUD = "ply\nformat ascii 1.0\nelement vertex 0\n" + "".join(f"property float {axis}\n" for axis in "xyz")
CLOUD += "end_header\n"
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.obj", "v\n", ""),
        ("a.obj", "v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "vertices: 1 of 3 vertices are not finite or exceed 1e+15"),
        ("a.obj", "v 0 0 0\nv 1 0 1e300\nv 0 1 0\nf 1 2 3\n", "vertices: 1 of 3 vertices are not finite"),
        ("a.obj", "v 0 0 0\nv 1 0 fish\nv 0 1 0\nf 1 2 3\n", "cannot be read as a mesh"),
        ("a.obj", TRIANGLE + "f 1 2 9\n", "cannot be read as a mesh"),
        ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n9 0 1 2\n3 0 1 2\n", "cannot be read as a mesh"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "faces: all faces have zero area"),
        ("a.stl", "\0" * 80 + "\7\0\0\0" + "\0" * 60, "faces: the file contains no faces"),
        ("a.stl", "solid x\n" + "facet normal 0 0 1\n" * 50, "faces: 50 exceeds the limit of 20"),
        ("a.stl", "", "faces: the file contains no faces"),
        ("a.ply", CLOUD, "faces: the file contains no faces"),
        ("a.stl", "\0" * 84, "faces: the file contains no faces"),
        *(("a.glb", data, "is not a glTF file, or is damaged; export it again") for data in ("", "junk\n", "\0" * 64)),
        *((f"a{suffix}", data, "") for suffix in (".gltf", ".ply", ".obj") for data in ("", "x", "glTF\2\0\0\0")),
    ],
)
def test_a_broken_file_is_one_line_that_names_the_field(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, data: str, told: str
) -> None:
    monkeypatch.setattr(LIMITS, "triangles", 20)
    path = tmp_path / name
    path.write_bytes(data.encode())
    assert refusal(load_mesh, path).startswith(f"{path}: {told}")


FAR = np.array([4.5e6, 5.4e6, 300.0])  # an offset as in UTM coordinates


def ball_text(offset: np.ndarray, kind: str) -> str:
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = "".join(("v " if kind == "obj" else "") + f"{x} {y} {z}\n" for x, y, z in ball.vertices + offset)
    first, count = ("f", 1) if kind == "obj" else ("3", 0)
    faces = "".join(f"{first} {a} {b} {c}\n" for a, b, c in ball.faces + count)
    ply = f"ply\nformat ascii 1.0\nelement vertex {len(ball.vertices)}\n"
    ply += "".join(f"property double {axis}\n" for axis in "xyz")
    of_faces = f"element face {len(ball.faces)}\nproperty list uchar int vertex_indices\n"
    if kind == "points":
        return f"{ply}end_header\n{vertices}"
    head = {"obj": "", "off": f"OFF\n{len(ball.vertices)} {len(ball.faces)} 0\n", "ply": f"{ply}{of_faces}end_header\n"}
    return head[kind] + vertices + faces


@pytest.mark.parametrize("kind", ["obj", "off", "ply", "points"])
def test_a_mesh_far_from_its_origin_looks_as_one_there(tmp_path: Path, drawn: Any, kind: str) -> None:
    """float32 has a spacing of 0.5 at these coordinates, and the ball a radius of 1."""
    pictures = []
    for name, offset in (("near", 0 * FAR), ("far", FAR)):
        path = tmp_path / f"{name}.{kind.replace('points', 'ply')}"
        path.write_text(ball_text(offset, kind))
        pictures.append(drawn(path, EYE, axes="+z +x").astype(int))
    assert (pictures[0][..., 3] > 128).sum() > 1000
    assert np.abs(pictures[0] - pictures[1]).max() <= 2


def test_a_binary_stl_far_from_its_origin_is_centred(tmp_path: Path, opened: Any) -> None:
    """Its float32 corners are exact; what is drawn with must not round them again."""
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    box.apply_translation([2.0**23, 0, 0])
    box.export(tmp_path / "far.stl")
    source = opened(tmp_path / "far.stl")
    (part,) = source.parts
    assert np.ptp(part.positions, axis=0).tolist() == [2.0, 1.0, 1.0]
    assert np.abs(part.positions).max() <= 1.0 and np.abs(source.stack_from_parts[0][:3, 3]).max() < 1.0


COMMENTED = {
    "a.obj": "g Name # one\nv 0 0 0 # end\n   # indented\nv 1 0 0\t# tab\n\nv 0 1 0\n\nf 1 2 3 # face\n# last",
    "a.ply": "ply\nformat ascii 1.0\ncomment one\nelement vertex 3\n"
    + "".join(f"property float {axis}\n" for axis in "xyz")
    + "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    + "\n0 0 0\ncomment two\n\n1 0 0\r\n\n0 1 0\n   \n3 0 1 2\n",
    "a.stl": "# one\nsolid x # two\nfacet normal 0 0 1 # three\n outer loop\n vertex 0 0 0 # four\n"
    + " vertex 1 0 0 # five\n vertex 0 1 0\n endloop\nendfacet\nendsolid x\n",
}


@pytest.mark.parametrize("libraries", ["mtllib a.mtl b.mtl\n", "mtllib a.mtl\nmtllib none.mtl\nmtllib b.mtl\n"])
def test_an_obj_may_have_several_files_of_materials(tmp_path: Path, libraries: str) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "b.mtl").write_text("newmtl green\nKd 0 1 0\n")
    (tmp_path / "a.obj").write_text(libraries + TRIANGLE + "usemtl red\nf 1 2 3\nusemtl green\nf 3 2 1\n")
    assert {part.colour for part in load_mesh(tmp_path / "a.obj").parts} == {(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)}


def test_numbers_that_count_back_in_an_obj_do_so_from_their_line(tmp_path: Path) -> None:
    triangle = "v {0} 0 0\nv {0} 1 0\nvt 0 {0}\nvt 1 {0}\nv {0} 0 1\nvt 1 1\nf -3/-3 -2/-2 \\\n-1/-1\n"
    (tmp_path / "a.obj").write_text(triangle.format(0) + "# -1\n" + triangle.format(5) + "f 1/1 -2/5 -1/6\nl -1 -2\n")
    (part,) = load_mesh(tmp_path / "a.obj").parts
    assert [sorted(xs) for xs in part.shape.positions_m[part.shape.triangles, 0].tolist()] == [
        [0] * 3,
        [5] * 3,
        [0, 5, 5],
    ]


def test_vertices_of_an_obj_without_colours_are_grey_among_coloured_ones(tmp_path: Path) -> None:
    """Objects of several programs in one file; the first has no colours."""
    (tmp_path / "a.obj").write_text(TRIANGLE + "f 1 2 3\nv 5 0 0 1 0 0\nv 6 0 0 1 0 0\nv 5 1 0 1 0 0\nf 4 5 6\n")
    (part,) = load_mesh(tmp_path / "a.obj").parts
    assert part.vertex_colours is not None and part.vertex_colours[3:].tolist() == [[1, 0, 0]] * 3
    assert np.ptp(part.vertex_colours[:3], axis=0).max() == 0 and 0.6 < part.vertex_colours[0].min() < 0.9


@pytest.mark.parametrize("head", ["OFF\n4 1 0\n", "# one\nOFF 4 1 0 # counts\n", "OFF4 1 0\n"])
def test_elements_of_an_off_file_may_take_several_lines(tmp_path: Path, head: str) -> None:
    (tmp_path / "a.off").write_text(head + "0 0\n0\n1 0 0\n\n1 1 # corner\n0\n0 1 0\n4 0 1\n2\n3 255 0 0\n")
    data = load_mesh(tmp_path / "a.off")
    assert data.low.tolist() == [0, 0, 0] and data.high.tolist() == [1, 1, 0]
    assert len(data.parts[0].shape.triangles) == 2


@pytest.mark.parametrize("name", COMMENTED)
def test_comments_and_blank_lines_between_numbers_are_skipped(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(COMMENTED[name])
    data = load_mesh(tmp_path / name)
    assert data.low.tolist() == [0, 0, 0] and data.high.tolist() == [1, 1, 0]


def test_a_number_sign_in_a_material_s_name_is_no_comment(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red #1\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + TRIANGLE + "usemtl red #1\nf 1 2 3\n")
    assert load_mesh(tmp_path / "a.obj").parts[0].colour == (1.0, 0.0, 0.0)
