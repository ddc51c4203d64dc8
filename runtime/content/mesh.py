"""Meshes drawn with one lamp: glTF/GLB read by `gltf`, OBJ, PLY and STL by trimesh."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.content.base import ContentInfo
from runtime.content.gltf import file_of, load_gltf, texture_of
from runtime.content.placing import SceneFile
from runtime.content.ply import read_header
from runtime.content.rig import Binding, Node, Rig
from runtime.content.shapes import Shape
from runtime.content.triangles import DrawnPart, Part, TriangleSource
from runtime.errors import InputError, one_line
from runtime.records import F32, F64, U8
from runtime.support import progress, untrusted_input
from runtime.support.picture_header import decoded_picture
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.content")

UNCOLOURED = (0.70, 0.74, 0.80)  # of a file that says nothing of colours
GLTF = (".glb", ".gltf")
STL_HEAD, STL_FACET = 84, 50  # bytes of a binary file's head and of each of its triangles
LARGEST_COORDINATE = 1e15  # products of three still fit in float32's range


@dataclass(frozen=True, slots=True)
class MeshData:
    """A loaded file, in its own coordinates."""

    parts: tuple[Part, ...]  # each in its own frame
    rig: Rig  # that places and moves them
    low: F64  # (3,) corner of the box that holds it, however it moves; in the scene's frame
    high: F64


def prepare(file: SceneFile) -> Callable[[Any], MeshSource]:
    """Read it and make its outlines ready; the answer uploads them. Raises InputError."""
    data = load_mesh(file.path, animation=file.settings.animation)
    parts = []
    for number, part in enumerate(data.parts):
        progress.tell(f"{file.path.name}: outlines", number, len(data.parts))
        parts.append(DrawnPart(part))
    matrix = file.placed(data.low, data.high)
    info = ContentInfo(file.path.stem, moving=data.rig.moves, background=file.background)
    return lambda context: MeshSource(parts, matrix, context=context, info=info, rig=data.rig)


def load_mesh(path: Path, *, animation: str = "") -> MeshData:
    """Read a file. Raises InputError: unreadable, over a limit, no faces, NaN vertices, a texture missing.

    animation: which one of a glTF plays; empty: the first.
    """
    progress.tell(f"reading {path.name}", 0)
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    if path.suffix.lower() in GLTF:
        return _boxed(path, *load_gltf(path, data, animation=animation))
    _check_counts(path, data)
    pictures: dict[int, U8] = {}
    with np.errstate(all="ignore"):  # coordinates beyond any scene overflow; they are refused below
        parts = [_part(mesh, path, pictures) for mesh in _loaded(path, data)]
    triangles = sum(len(part.shape.triangles) for part in parts)
    untrusted_input.within(triangles, LIMITS.triangles, source=path, field="faces")
    return _boxed(path, parts, Rig((Node(),), (0,), (Binding(0),) * len(parts)))


def _check(path: Path, parts: Sequence[Part]) -> None:
    """Raises InputError where nothing could be seen, or not drawn."""
    if not parts:
        raise InputError(path, "faces", "there are none")
    has_area = False
    for part in parts:
        points = part.shape.positions_m.astype(np.float64)
        broken = int((~(np.abs(points) <= LARGEST_COORDINATE).all(1)).sum())  # NaN too
        if broken:
            problem = f"{broken} of {len(points)} are not finite, or beyond {LARGEST_COORDINATE:g}"
            raise InputError(path, "vertices", problem)
        corner = points[part.shape.triangles]
        has_area |= bool(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).any())
    if not has_area:
        raise InputError(path, "faces", "none has an area")


def _boxed(path: Path, parts: Sequence[Part], rig: Rig) -> MeshData:
    """With the box that holds all of it, however it moves."""
    _check(path, parts)
    corners = []
    for number, time_s in enumerate(rig.times_s()):
        progress.tell(f"{path.name}: places", number)
        with np.errstate(all="ignore"):  # what overflows is refused by its box
            for shape, matrix in rig.posed([part.shape for part in parts], time_s):
                points = shape.positions_m @ matrix[:3, :3].T + matrix[:3, 3]
                corners += [points.min(0), points.max(0)]
    if not (np.abs(corners) <= LARGEST_COORDINATE).all():  # nor NaN
        raise InputError(path, "nodes", f"place vertices beyond {LARGEST_COORDINATE:g}")
    return MeshData(tuple(parts), rig, np.min(corners, axis=0), np.max(corners, axis=0))


def _check_counts(path: Path, data: bytes) -> None:
    """What a file promises, before its loader takes memory for it. Raises InputError."""
    suffix, promised = path.suffix.lower(), 0
    if suffix == ".ply":
        read_header(path)
    elif suffix == ".stl":
        text = data[:5] == b"solid" and b"facet normal" in data[:1024]
        promised = data.count(b"facet normal") if text else (len(data) - STL_HEAD) // STL_FACET
    elif suffix == ".obj":
        promised = data.count(b"\nf ")
    untrusted_input.within(promised, LIMITS.triangles, source=path, field="faces")


def _loaded(path: Path, data: bytes) -> list[Any]:
    """Every trimesh of a file that has faces. Raises InputError."""
    import trimesh

    kind = path.suffix.lower().removeprefix(".")

    class Beside(trimesh.resolvers.FilePathResolver):
        """What a loader reads beside a file: it passes over what it does not get, so that this keeps why."""

        refused: InputError | None = None
        pixels = 0  # of all textures
        has_materials = kind != "obj" or b"mtllib" in data

        def get(self, name: str) -> bytes:
            try:
                beside = file_of(name, source=path, field="texture")
                found = untrusted_input.read_bytes(beside, most_bytes=LIMITS.file_bytes, source=path, field="texture")
                if not name.lower().endswith(".mtl"):
                    image = decoded_picture(found, source=path, field="texture", name=untrusted_input.shown(name))
                    self.pixels += image.width * image.height
                    untrusted_input.within(self.pixels, LIMITS.texture_pixels, source=path, field="textures' pixels")
            except InputError as error:
                if name.lower().endswith(".mtl"):
                    log.warning("%s: is drawn grey without its materials (%s)", path, error.problem)
                    self.has_materials = False
                    raise OSError from None
                self.refused = error
                raise
            return found

    progress.tell(f"{path.name}: triangles", 0)
    resolver = Beside(str(path))
    # Of an OBJ only names and comments can be other than ASCII, and exporters differ in how they write them.
    file = io.StringIO(data.decode("utf-8", errors="replace")) if kind == "obj" else io.BytesIO(data)
    try:
        geometries: list[Any] = list(trimesh.load_scene(file, file_type=kind, resolver=resolver, process=False).dump())
    except Exception as error:  # loaders raise whatever their parsers do
        problem = one_line(str(error), most=120)
        raise InputError(path, "", f"cannot be read as a mesh ({type(error).__name__}: {problem})") from None
    if resolver.refused is not None:
        raise resolver.refused
    meshes = [item for item in geometries if getattr(item, "faces", None) is not None and len(item.faces)]
    for mesh in meshes:
        if mesh.visual.kind == "texture" and not resolver.has_materials:  # it has the loader's own then
            mesh.visual = trimesh.visual.ColorVisuals(mesh)
    return meshes


def _part(mesh: Any, path: Path, pictures: dict[int, U8]) -> Part:
    """Of a trimesh: its texture alone, as other viewers show it, or colours of its faces or vertices, or grey."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, "faces", "are no triangles of vertices that are there")
    normals = np.asarray(mesh.vertex_normals)
    visual, kind = mesh.visual, mesh.visual.kind
    picture, colour, colours = None, (1.0, 1.0, 1.0), None
    uv: Any
    if kind == "texture":
        picture, colour = _material(visual.material, pictures)
        if path.suffix.lower() == ".ply":  # which has no materials; the loader's own is grey
            colour = (1.0, 1.0, 1.0)
    elif kind == "vertex":
        colours = visual.vertex_colors
    elif kind == "face":
        colours, normals = np.repeat(visual.face_colors, 3, axis=0), np.repeat(mesh.face_normals, 3, axis=0)
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    else:
        colour = UNCOLOURED
    if picture is None or visual.uv is None:
        picture, uv = None, np.zeros((len(vertices), 2))
    else:
        uv = np.column_stack([visual.uv[:, 0], 1.0 - visual.uv[:, 1]])
    if not np.isfinite(uv).all():
        raise InputError(path, "texture coordinates", "are not all finite")
    positions, normals, uv = (array.astype(np.float32) for array in (vertices, normals, uv))
    shape = Shape(positions, normals, uv, faces.astype(np.int32))
    return Part(shape, picture=picture, colour=colour, vertex_colours=None if colours is None else _unit(colours))


def _unit(colours: Any) -> F32:
    """(n, 3) colours of either type as floats in [0, 1]."""
    numbers = np.asarray(colours)[..., :3]
    scale = np.float32(255.0 if numbers.dtype == np.uint8 else 1.0)
    return np.asarray(np.clip(numbers.astype(np.float32) / scale, 0.0, 1.0), dtype=np.float32)


def _material(material: Any, pictures: dict[int, U8]) -> tuple[U8 | None, tuple[float, float, float]]:
    """Texture (RGBA) and colour of a trimesh material: they multiply, as in glTF.

    A texture's colour is white where it says black: exporters write so who mean the texture alone.
    """
    image, factor = getattr(material, "image", None), getattr(material, "diffuse", None)
    red, green, blue = _unit(np.ones(3) if factor is None else factor).tolist()
    if image is None:
        return None, UNCOLOURED if factor is None else (red, green, blue)
    if id(image) not in pictures:
        pictures[id(image)] = texture_of(image)
    return pictures[id(image)], (red, green, blue) if red or green or blue else (1.0, 1.0, 1.0)


class MeshSource(TriangleSource):
    """A loaded mesh at its place in the stack frame, and moving where its file says so."""

    def __init__(
        self, parts: Sequence[DrawnPart], stack_from_scene: F64, *, context: Any, info: ContentInfo, rig: Rig
    ) -> None:
        self._stack_from_scene, self._rig = stack_from_scene, rig
        self._at_rest = [part.part.shape for part in parts]
        self._posed_for: float | None = None
        super().__init__(parts, [stack_from_scene] * len(parts), context=context, info=info)

    def places(self, time_ns: int) -> Sequence[F64]:
        """Deforms the parts that bend, too."""
        period_ns = round(self._rig.duration_s * NS_PER_S)
        time_s = time_ns % period_ns / NS_PER_S if period_ns else 0.0
        if time_s != self._posed_for:
            placed = self._rig.posed(self._at_rest, time_s)
            for part, at_rest, (shape, _) in zip(self.parts, self._at_rest, placed, strict=True):
                if shape is not at_rest:
                    part.deform(shape)
            self.stack_from_parts = [self._stack_from_scene @ matrix for _, matrix in placed]
            self._posed_for = time_s
        return self.stack_from_parts
