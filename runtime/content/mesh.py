"""Meshes drawn with one lamp: glTF/GLB read by `gltf`, OBJ, PLY and STL by trimesh."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import LimitSettings
from runtime.content import camera
from runtime.content.base import ContentInfo, DrawingSource, View
from runtime.content.gltf import LARGEST_TEXTURE_PX, GltfScene, load_gltf
from runtime.content.gltf_header import file_of
from runtime.content.ply import check_counts
from runtime.content.rig import Pose, Rig, deformed
from runtime.content.shapes import Shape
from runtime.content.triangles import Part, ReadyPart, TrianglePainter
from runtime.errors import InputError, MissingPart, one_line
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64, U8
from runtime.support import foreign, progress
from runtime.support.gl import DrawnPicture
from runtime.support.picture_header import check_picture

UNCOLOURED = (0.70, 0.74, 0.80)  # of an STL, which has no colours
GLTF = (".glb", ".gltf")
STL_HEAD, STL_FACET = 84, 50  # bytes of a binary file's head and of each of its triangles
LIBRARY_BYTES_MAX = 16 << 20  # of an OBJ's materials
LARGEST_COORDINATE = 1e15  # products of three still fit in float32's range


@dataclass(frozen=True, slots=True)
class MeshData:
    """A loaded file, in its own coordinates."""

    name: str
    parts: tuple[Part, ...]  # in the scene's frame; where there is a rig, each in its own
    low: F64  # (3,) corner of the box that holds it, however it moves
    high: F64
    rig: Rig | None = None  # that moves it; None: it stands still


def load_mesh(path: Path, *, limits: LimitSettings | None = None, animation: str = "") -> MeshData:
    """Read a file. Raises InputError: unreadable, over a limit, no faces, NaN vertices, a texture missing.

    animation: which one of a glTF plays; empty: the first.
    """
    limits = limits or LimitSettings()
    progress.tell(f"reading {path.name}", 0)
    data = foreign.read_bytes(path, most_bytes=round(limits.file_mib * foreign.MIB))
    if path.suffix.lower() in GLTF:
        return _of_gltf(path, load_gltf(path, data, limits=limits, animation=animation))
    if importlib.util.find_spec("trimesh") is None:
        raise MissingPart("meshes need trimesh: pip install trimesh")
    _refuse_what_loaders_hide(path, data, limits)
    progress.tell(f"{path.name}: triangles", 0)
    try:
        with np.errstate(all="ignore"):  # coordinates beyond any scene overflow in the loader; they are told below
            geometries: list[Any] = list(_scene(path, data, limits).dump())
    except InputError:
        raise
    except Exception as error:  # loaders raise whatever their parsers do
        problem = one_line(str(error), most=120)
        raise InputError(path, "", f"cannot be read as a mesh ({type(error).__name__}: {problem})") from None
    meshes = [item for item in geometries if getattr(item, "faces", None) is not None and len(item.faces)]
    pictures: dict[int, U8] = {}
    parts = []
    for number, mesh in enumerate(meshes):
        progress.tell(f"{path.name}: parts", number, len(meshes))
        part = _part(mesh, path, pictures)
        # White before white is hard to see.
        parts.append(replace(part, colour=UNCOLOURED) if path.suffix.lower() == ".stl" else part)
    _refuse_empty(path, parts)
    return _boxed(path, parts, [part.shape.positions_m for part in parts])


def _refuse_empty(path: Path, parts: Sequence[Part]) -> None:
    if not parts:
        raise InputError(path, "faces", "there are none")
    for part in parts:
        huge = int((np.abs(part.shape.positions_m) > LARGEST_COORDINATE).any(1).sum())
        if huge:
            problem = f"{huge} of {len(part.shape.positions_m)} are beyond {LARGEST_COORDINATE:g}"
            raise InputError(path, "vertices", problem)
    if not any(_has_area(part.shape) for part in parts):
        raise InputError(path, "faces", "none has an area")


def _boxed(path: Path, parts: Sequence[Part], points: Sequence[F32], rig: Rig | None = None) -> MeshData:
    """points: (n, 3) each, that the box is to hold."""
    corners = np.array([bound(array, axis=0) for array in points for bound in (np.min, np.max)], dtype=np.float64)
    low, high = corners.min(0), corners.max(0)
    if not (np.abs(corners) <= LARGEST_COORDINATE).all():  # nor NaN
        raise InputError(path, "nodes", f"place vertices beyond {LARGEST_COORDINATE:g}")
    return MeshData(path.stem, tuple(parts), low, high, rig)


def _of_gltf(path: Path, scene: GltfScene) -> MeshData:
    """Parts that stand still are carried into the scene's frame once; those of a rig that moves stay in their own."""
    _refuse_empty(path, scene.parts)
    rig = scene.rig
    points = []
    for number, time_s in enumerate(rig.times_s()):
        progress.tell(f"{path.name}: places", number)
        pose = rig.pose(time_s)
        with np.errstate(all="ignore"):  # what overflows is told by its box
            points += [shape.positions_m for shape in _shapes(scene.parts, rig, pose)]
    if rig.moves:
        return _boxed(path, scene.parts, points, rig)
    still = [replace(part, shape=shape) for part, shape in zip(scene.parts, _shapes(scene.parts, rig, rig.pose(0.0)))]
    return _boxed(path, still, points)


def _shapes(parts: Sequence[Part], rig: Rig, pose: Pose) -> list[Shape]:
    """Every part's shape in the scene's frame."""
    return [_carried(*placed) for placed in zip(_posed(parts, rig, pose), pose.scene_from_part, strict=True)]


def _posed(parts: Sequence[Part], rig: Rig, pose: Pose) -> list[Shape]:
    """Every part's shape in its own frame, deformed."""
    shapes = []
    for part, binding, weights, bones in zip(parts, rig.bindings, pose.morph_weights, pose.bones, strict=True):
        shape = part.shape
        if binding.deforms:
            positions, normals = deformed(shape.positions_m, shape.normals, binding, weights, bones)
            shape = replace(shape, positions_m=positions, normals=normals)
        shapes.append(shape)
    return shapes


def _carried(shape: Shape, matrix: F64) -> Shape:
    """A shape through a 4x4 affine map, its normals still outwards."""
    if (matrix == np.eye(4)).all():
        return shape
    linear = matrix[:3, :3]
    positions = (shape.positions_m @ linear.T + matrix[:3, 3]).astype(np.float32)
    normals = shape.normals @ np.linalg.pinv(linear)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0).astype(np.float32)
    mirrored = np.linalg.det(linear) < 0
    triangles = np.ascontiguousarray(shape.triangles[:, [0, 2, 1]]) if mirrored else shape.triangles
    return Shape(positions, normals, shape.uv, triangles)


def _scene(path: Path, data: bytes, limits: LimitSettings) -> Any:
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    # Of an OBJ only names and comments can be other than ASCII, and exporters differ in how they write them.
    file = io.StringIO(data.decode("utf-8", errors="replace")) if kind == "obj" else io.BytesIO(data)
    return trimesh.load_scene(file, file_type=kind, resolver=_resolver(path, limits), process=False)


def _resolver(path: Path, limits: LimitSettings) -> Any:
    """What a loader reads beside a file: regular files there, within the limit."""
    import trimesh

    class Beside(trimesh.resolvers.Resolver):
        def __init__(self) -> None:
            pass

        def get(self, name: str) -> bytes:
            beside = file_of(name, source=path, field="texture")
            if beside is None:
                raise InputError(path, "texture", "data in place of a name")
            return foreign.read_bytes(
                beside, most_bytes=round(limits.file_mib * foreign.MIB), source=path, field="texture"
            )

        def write(self, name: str, data: Any) -> None:
            raise NotImplementedError  # only exporters do

        def namespaced(self, namespace: str) -> Any:
            return self

        def keys(self) -> list[str]:
            return []

    return Beside()


def _has_area(shape: Shape) -> bool:
    corner = shape.positions_m.astype(np.float64)[shape.triangles]
    return bool(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).any())


def _part(mesh: Any, path: Path, pictures: dict[int, U8]) -> Part:
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(path, "vertices", f"have {vertices.shape[-1]} coordinates and faces {faces.shape[-1]} corners")
    if not np.isfinite(vertices).all():
        broken = int((~np.isfinite(vertices).all(1)).sum())
        raise InputError(path, "vertices", f"{broken} of {len(vertices)} are not finite")
    huge = int((np.abs(vertices) > LARGEST_COORDINATE).any(1).sum())
    if huge:  # beyond float32 too, perhaps
        raise InputError(path, "vertices", f"{huge} of {len(vertices)} are beyond {LARGEST_COORDINATE:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, "faces", "refer to vertices that are not there")
    uv, picture, colour, colours = None, None, (1.0, 1.0, 1.0), None
    kind = mesh.visual.kind
    if kind == "texture":
        uv = mesh.visual.uv
        picture, colour = _material(mesh.visual.material, pictures)
        attributes = getattr(mesh.visual, "vertex_attributes", {})
        if "color" in attributes:
            colours = _unit(np.asarray(attributes["color"])[:, :3])
    elif kind == "face":
        colours_of_faces = _unit(np.asarray(mesh.visual.face_colors)[:, :3])
        vertices, colours = vertices[faces].reshape(-1, 3), np.repeat(colours_of_faces, 3, axis=0)
        normals = np.repeat(mesh.face_normals, 3, axis=0)
        faces = np.arange(len(vertices)).reshape(-1, 3)
    elif kind == "vertex":
        colours = _unit(np.asarray(mesh.visual.vertex_colors)[:, :3])
    if kind != "face":
        normals = np.asarray(mesh.vertex_normals)
    textured = picture is not None and uv is not None
    flipped = (
        np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]) if textured and uv is not None else np.zeros((len(vertices), 2))
    )
    if not np.isfinite(flipped).all():
        raise InputError(path, "texture coordinates", "are not all finite")
    shape = Shape(
        vertices.astype(np.float32), normals.astype(np.float32), flipped.astype(np.float32), faces.astype(np.int32)
    )
    return Part(shape, picture=picture if textured else None, colour=colour, vertex_colours=colours)


def _unit(colours: Any) -> Any:
    """Colours of either type as floats in [0, 1]."""
    scale = 255.0 if colours.dtype.kind in "ui" and colours.dtype.itemsize == 1 else 1.0
    return np.clip(colours.astype(np.float32) / scale, 0.0, 1.0)


def _material(material: Any, pictures: dict[int, U8]) -> tuple[U8 | None, tuple[float, float, float]]:
    """Texture (RGBA) and colour of a trimesh material: they multiply, as in glTF.

    A texture's colour is white where it says black: exporters write so who mean the texture alone.
    """
    image, factor = getattr(material, "image", None), getattr(material, "diffuse", None)
    numbers = np.ones(3) if factor is None else _unit(np.asarray(factor)[:3])
    if image is not None and not numbers.any():
        numbers = np.ones(3)
    colour = (float(numbers[0]), float(numbers[1]), float(numbers[2]))
    if image is None:
        return None, colour
    if id(image) not in pictures:
        if max(image.size) > LARGEST_TEXTURE_PX:
            image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
        pictures[id(image)] = np.asarray(image.convert("RGBA"))
    return pictures[id(image)], colour


def _refuse_what_loaders_hide(path: Path, data: bytes, limits: LimitSettings) -> None:
    """The loader passes over textures that aren't there or aren't pictures, and over an OBJ's broken numbers."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        check_counts(path, data, limits=limits)
    elif suffix == ".stl":
        _check_stl(path, data, limits)
    elif suffix == ".obj":
        for name in _of_obj(path, data, limits):
            picture = file_of(name, source=path, field="texture")
            if picture is None or not picture.is_file():
                raise InputError(path, "texture", f"{foreign.shown(name, most=200)} is not there")
            held = foreign.read_bytes(
                picture, most_bytes=round(limits.file_mib * foreign.MIB), source=path, field="texture"
            )
            check_picture(held, source=path, field="texture", name=foreign.shown(name, most=200), limits=limits)


def _check_stl(path: Path, data: bytes, limits: LimitSettings) -> None:
    """How many triangles it promises. Raises InputError."""
    promised = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little") if len(data) >= STL_HEAD else 0
    if len(data) != STL_HEAD + STL_FACET * promised and data[:5] == b"solid":
        promised = data.count(b"facet normal")  # of text
    elif len(data) < STL_HEAD + STL_FACET * promised or len(data) < STL_HEAD:
        held = max(len(data) - STL_HEAD, 0) // STL_FACET
        raise InputError(path, "faces", f"the file is cut off: {promised:,} are promised and {held:,} there")
    foreign.within(promised, limits.triangles, source=path, field="faces", limit="limits.triangles")


def _of_obj(path: Path, data: bytes, limits: LimitSettings) -> list[str]:
    """Names of the picture files of its materials. Raises InputError."""
    lines = data.decode("utf-8", errors="replace").splitlines()
    positions = [line for line in lines if line.startswith("v ")]
    broken = sum("nan" in line.lower() or "inf" in line.lower() for line in positions)
    if broken:
        raise InputError(path, "vertices", f"{broken} of {len(positions)} are not finite")
    foreign.within(len(positions), 3 * limits.triangles, source=path, field="v", limit="3 for each of limits.triangles")
    triangles = 0
    for line in lines:
        if not line.startswith("f "):
            continue
        corners = line.split()[1:]
        triangles += max(len(corners) - 2, 0)
        # The loader takes a 0 for the last vertex; the format counts from 1, or from -1 backwards.
        if any(corner.split("/")[0] == "0" for corner in corners):
            raise InputError(path, "faces", "refer to vertex 0; the first is 1")
    foreign.within(triangles, limits.triangles, source=path, field="f", limit="limits.triangles")
    wanted = []
    for line in lines:
        if line.startswith("mtllib "):
            name = line.split(maxsplit=1)[1].strip()
            library = file_of(name, source=path, field="mtllib")
            if library is None or not library.exists():
                raise InputError(path, "mtllib", f"{foreign.shown(name, most=200)} is not there")
            held = foreign.read_bytes(library, most_bytes=LIBRARY_BYTES_MAX, source=path, field="mtllib")
            text = held.decode("utf-8", errors="replace").splitlines()
            wanted += [item.split(maxsplit=1)[1].strip() for item in map(str.strip, text) if _names_texture(item)]
    return wanted


def _names_texture(line: str) -> bool:
    return line.lower().startswith("map_kd ") and len(line.split()) > 1


class MeshSource(DrawingSource):
    """A loaded mesh at its place in the stack frame, and moving where its file says so."""

    def __init__(
        self,
        data: MeshData,
        *,
        stack_from_scene: F64,
        context: Any,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        samples: int = 0,
        parts: Sequence[ReadyPart] | None = None,
    ) -> None:
        """parts: those of `data`, where they were made ready on another thread."""
        self.draws_in = context
        self._painter = TrianglePainter(parts or data.parts, context=context, background=background, samples=samples)
        self._data, self._rig = data, data.rig
        self._stack_from_scene = stack_from_scene
        self._placed = [stack_from_scene] * len(data.parts)
        self._posed_for: float | None = None
        box = camera.box_corners(data.low, data.high)
        x = box @ stack_from_scene[0, :3] + stack_from_scene[0, 3]
        used = {feature for part in data.parts for feature in part.features}
        names = {"PICTURE": "textures", "COLOURED": "vertex colours", "HOLES": "cut-outs"}
        self.info = ContentInfo(
            name=data.name,
            moving=data.rig is not None,
            depth_range_m=(float(x.min()), float(x.max())),
            background=background,
            left_out=tuple(text for feature, text in names.items() if feature not in used),
        )

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        return self._painter.paint(view, self._places(time_ns))

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        return self._painter.extent(view, self._places(time_ns))

    def close(self) -> None:
        self._painter.close()

    def _places(self, time_ns: int) -> list[F64]:
        """4x4 stack_from_part of every part; deforms those that bend."""
        if self._rig is None:
            return self._placed
        period_ns = round(self._rig.duration_s * NS_PER_S)
        time_s = time_ns % period_ns / NS_PER_S if period_ns else 0.0
        if time_s != self._posed_for:
            pose = self._rig.pose(time_s)
            for index, shape in enumerate(_posed(self._data.parts, self._rig, pose)):
                if self._rig.bindings[index].deforms:
                    self._painter.deform(index, shape)
            self._placed = [self._stack_from_scene @ matrix for matrix in pose.scene_from_part]
            self._posed_for = time_s
        return self._placed
