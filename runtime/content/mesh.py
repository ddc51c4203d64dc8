"""Meshes drawn with one lamp: glTF/GLB, OBJ, PLY and STL, read by trimesh."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from runtime.content.base import ContentInfo
from runtime.content.gltf import check_gltf, cut_alpha, file_of
from runtime.content.placing import SceneFile
from runtime.content.ply import read_header
from runtime.content.shapes import Shape
from runtime.content.triangles import DrawnPart, Part, TriangleSource
from runtime.errors import InputError, one_line
from runtime.records import F32, F64, U8
from runtime.support import progress, untrusted_input
from runtime.support.picture_header import decoded_picture
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.content")

UNCOLOURED = (0.70, 0.74, 0.80)  # of a file without colours
WHITE = (1.0, 1.0, 1.0)
GLTF = (".glb", ".gltf")
STL_HEAD, STL_FACET = 84, 50  # bytes of a binary file's head and of each of its triangles
LARGEST_COORDINATE = 1e15  # products of three still fit in float32's range
LARGEST_TEXTURE_PX = 4096
AT_ONCE = 1 << 17  # vertices or faces that are worked on together: bounds the memory


@dataclass(frozen=True, slots=True)
class MeshData:
    """A loaded file, in its own coordinates."""

    parts: tuple[Part, ...]
    low: F64  # (3,) corner of the box that holds it
    high: F64


def prepare(file: SceneFile) -> Callable[..., TriangleSource]:
    """Read the file and find its outlines; the result uploads them to GL. Raises InputError."""
    data = load_mesh(file.path)
    parts = []
    for number, part in enumerate(data.parts):
        progress.tell(f"{file.path.name}: outlines", number, len(data.parts))
        parts.append(DrawnPart(part))
    places = [file.placed(data.low, data.high)] * len(parts)
    info = ContentInfo(file.path.stem, background=file.background)
    return partial(TriangleSource, parts, places, info=info)


def load_mesh(path: Path) -> MeshData:
    """Read a mesh. Raises InputError: unreadable, over a limit, no faces, NaN, a missing texture."""
    progress.tell(f"reading {path.name}", 0)
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    _check_counts(path, data)
    pictures: dict[int, U8] = {}
    with np.errstate(all="ignore"):  # coordinates beyond any scene overflow; they are refused below
        parts = [_binary_stl(data)] if _is_binary_stl(path, data) else []
        placed = [] if parts else _loaded(path, data)
        for number, (mesh, matrix) in enumerate(placed):
            progress.tell(f"{path.name}: parts", number, len(placed))
            parts.append(_part(mesh, matrix, path, pictures))
    triangles = sum(len(part.shape.triangles) for part in parts)
    untrusted_input.within(triangles, LIMITS.triangles, source=path, field="faces")
    _check(path, parts)
    low, high = (
        np.asarray(end([end(part.shape.positions_m, axis=0) for part in parts], axis=0), np.float64)
        for end in (np.min, np.max)
    )
    return MeshData(tuple(parts), low, high)


def _check(path: Path, parts: Sequence[Part]) -> None:
    """Raises InputError where nothing could be seen, or not drawn."""
    if not parts:
        raise InputError(path, "faces", "there are none")
    has_area = False
    for part in parts:
        points = part.shape.positions_m
        broken = int((~(np.abs(points) <= LARGEST_COORDINATE).all(1)).sum())  # NaN too
        if broken:
            problem = f"{broken} of {len(points)} are not finite, or beyond {LARGEST_COORDINATE:g}"
            raise InputError(path, "vertices", problem)
        for first in range(0, len(part.shape.triangles), AT_ONCE):
            if not has_area:
                corner = points[part.shape.triangles[first : first + AT_ONCE]].astype(np.float64)
                has_area = bool(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).any())
    if not has_area:
        raise InputError(path, "faces", "none has an area")


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


def _is_binary_stl(path: Path, data: bytes) -> bool:
    count = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little")
    return path.suffix.lower() == ".stl" and count > 0 and len(data) == STL_HEAD + count * STL_FACET


def _binary_stl(data: bytes) -> Part:
    """Without trimesh, which takes ten times the memory of the largest files."""
    facets = np.frombuffer(data, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")], offset=STL_HEAD)
    positions, normals = np.empty((2, len(facets), 3, 3), np.float32)
    for first in range(0, len(facets), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        positions[rows] = facets["corners"][rows]
        corner = positions[rows].astype(np.float64)
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normals[rows] = (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30))[:, None]
    triangles = np.arange(3 * len(facets), dtype=np.int32).reshape(-1, 3)
    uv = np.zeros((triangles.size, 2), np.float32)
    return Part(Shape(positions.reshape(-1, 3), normals.reshape(-1, 3), uv, triangles), colour=UNCOLOURED)


def _loaded(path: Path, data: bytes) -> list[tuple[Any, F64]]:
    """Every trimesh of a file that has faces, and 4x4 scene_from_mesh. Raises InputError."""
    import trimesh

    kind = path.suffix.lower().removeprefix(".")

    @cache
    def beside(name: str) -> bytes:
        field = "uri" if path.suffix.lower() in GLTF else "texture"
        place = file_of(name, source=path, field=field)
        return untrusted_input.read_bytes(place, most_bytes=LIMITS.file_bytes, source=path, field=field)

    class Beside(trimesh.resolvers.FilePathResolver):
        """Reads files beside the mesh and keeps the reason of a refusal, which loaders would skip."""

        refused: InputError | None = None
        pixels = 0  # of all textures
        has_materials = kind != "obj" or b"mtllib" in data

        def get(self, name: str) -> bytes:
            try:
                found = beside(name)
                if path.suffix.lower() not in GLTF and not name.lower().endswith(".mtl"):
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

    if path.suffix.lower() in GLTF:
        check_gltf(path, data, beside)
    progress.tell(f"{path.name}: triangles", 0)
    resolver = Beside(str(path))
    # Of an OBJ only names and comments can be other than ASCII, and exporters differ in how they write them.
    file = io.StringIO(data.decode("utf-8", errors="replace")) if kind == "obj" else io.BytesIO(data)
    try:
        scene = trimesh.load_scene(file, file_type=kind, resolver=resolver, process=False)
        placed = [(scene.geometry[name], matrix) for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)]
    except Exception as error:  # loaders raise whatever their parsers do
        if resolver.refused is not None:
            raise resolver.refused from None
        problem = one_line(str(error), most=120)
        raise InputError(path, "", f"cannot be read as a mesh ({type(error).__name__}: {problem})") from None
    if resolver.refused is not None:
        raise resolver.refused
    placed = [(mesh, matrix) for mesh, matrix in placed if len(getattr(mesh, "faces", ()))]
    for mesh, _ in placed:
        if mesh.visual.kind == "texture" and not resolver.has_materials:  # it has the loader's own then
            mesh.visual = trimesh.visual.ColorVisuals(mesh)
    return placed


def _part(mesh: Any, matrix: F64, path: Path, pictures: dict[int, U8]) -> Part:
    """Of a trimesh: its material, and colours of its faces or vertices; grey where it has none of them."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, "faces", "are no triangles of vertices that are there")
    visual, kind = mesh.visual, mesh.visual.kind
    picture, colour, colours = None, WHITE, None
    uv: Any
    if kind == "texture":
        picture, colour = _material(visual.material, pictures)
        colours = visual.vertex_attributes.get("color")
        if path.suffix.lower() == ".ply":  # which has no materials; the loader's own is grey
            colour = WHITE
    elif kind == "vertex":
        colours = visual.vertex_colors
    elif kind == "face":
        colours = np.repeat(visual.face_colors, 3, axis=0)
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    elif path.suffix.lower() not in GLTF:  # whose default is white
        colour = UNCOLOURED
    normals = np.repeat(mesh.face_normals, 3, axis=0) if kind == "face" else mesh.vertex_normals
    if picture is None or visual.uv is None:
        picture, uv = None, np.zeros((len(vertices), 2), np.float32)
    else:
        uv = np.column_stack([visual.uv[:, 0], 1.0 - visual.uv[:, 1]])
    if not np.isfinite(uv).all():
        raise InputError(path, "texture coordinates", "are not all finite")
    positions, turned = np.empty((2, len(vertices), 3), np.float32)
    for first in range(0, len(vertices), AT_ONCE):  # in double precision
        rows = slice(first, first + AT_ONCE)
        positions[rows] = vertices[rows] @ matrix[:3, :3].T + matrix[:3, 3]
        normal = normals[rows] @ np.linalg.pinv(matrix[:3, :3])
        turned[rows] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    shape = Shape(positions, turned, uv.astype(np.float32), faces.astype(np.int32))
    return Part(shape, picture=picture, colour=colour, vertex_colours=None if colours is None else _unit(colours))


def _unit(colours: Any) -> F32:
    """(n, 3) colours, integers or fractions, as floats in [0, 1]."""
    numbers = np.asarray(colours)[..., :3]
    scale = np.float32(np.iinfo(numbers.dtype).max if numbers.dtype.kind == "u" else 1.0)
    return np.asarray(np.clip(numbers.astype(np.float32) / scale, 0.0, 1.0), dtype=np.float32)


def _material(material: Any, pictures: dict[int, U8]) -> tuple[U8 | None, tuple[float, float, float]]:
    """Texture (RGBA) and colour of a trimesh material: they multiply, as in glTF.

    A black factor beside a texture is taken for white: some exporters write it for the texture alone.
    """
    is_gltf = hasattr(material, "baseColorTexture")
    if is_gltf:
        image, factor = material.baseColorTexture, material.baseColorFactor
    else:
        image, factor = getattr(material, "image", None), getattr(material, "diffuse", None)
    red, green, blue = _unit(np.ones(3) if factor is None else factor).tolist()
    if image is None:
        return None, UNCOLOURED if factor is None and not is_gltf else (red, green, blue)
    if id(material) not in pictures:
        image = image.convert("RGBA")
        image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
        rgba = pictures[id(material)] = np.array(image)
        if is_gltf:
            cut_alpha(rgba, material)
    return pictures[id(material)], (red, green, blue) if red or green or blue else WHITE
