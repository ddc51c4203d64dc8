"""glTF/GLB, OBJ and PLY meshes, loaded by trimesh and drawn with one lamp."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import LimitSettings
from runtime.content.base import ContentInfo, DrawingSource, View
from runtime.content.gltf_header import check_gltf, file_of
from runtime.content.ply import check_counts
from runtime.content.shapes import Shape
from runtime.content.triangles import Part, ReadyPart, TrianglePainter
from runtime.errors import InputError, MissingPart, one_line
from runtime.optics.rect import PixelRect
from runtime.records import F64, U8
from runtime.support import foreign, progress
from runtime.support.gl import DrawnPicture
from runtime.support.picture_header import check_picture

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
LARGEST_TEXTURE_PX = 4096
LIBRARY_BYTES_MAX = 16 << 20  # of an OBJ's materials
LARGEST_COORDINATE = 1e15  # products of three still fit in float32's range


@dataclass(frozen=True, slots=True)
class MeshData:
    """A loaded file, in its own coordinates."""

    name: str
    parts: tuple[Part, ...]
    low: F64  # (3,) corner of the box that holds it
    high: F64


def load_mesh(path: Path, *, limits: LimitSettings | None = None) -> MeshData:
    """Read a file. Raises InputError: unreadable, over a limit, no faces, NaN vertices, a texture missing."""
    if importlib.util.find_spec("trimesh") is None:
        raise MissingPart("meshes need trimesh: pip install trimesh")
    limits = limits or LimitSettings()
    progress.tell(f"reading {path.name}", 0)
    data = foreign.read_bytes(path, most_bytes=round(limits.file_mib * foreign.MIB))
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
    if not meshes:
        raise InputError(path, "faces", "there are none")
    pictures: dict[int, U8] = {}
    parts = []
    for number, mesh in enumerate(meshes):
        progress.tell(f"{path.name}: parts", number, len(meshes))
        parts.append(_part(mesh, path, pictures))
    if not any(_has_area(part.shape) for part in parts):
        raise InputError(path, "faces", "none has an area")
    corners = np.array([bound(part.shape.positions_m, axis=0) for part in parts for bound in (np.min, np.max)])
    return MeshData(path.stem, tuple(parts), corners.min(0).astype(np.float64), corners.max(0).astype(np.float64))


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
    if huge:
        raise InputError(path, "vertices", f"{huge} of {len(vertices)} are beyond {LARGEST_COORDINATE:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, "faces", "refer to vertices that are not there")
    uv, picture, colour, colours = None, None, (1.0, 1.0, 1.0), None
    kind = mesh.visual.kind
    if kind == "texture":
        uv = mesh.visual.uv
        picture, colour = _material(mesh.visual.material, pictures)
        attributes = getattr(mesh.visual, "vertex_attributes", {})
        if picture is None and "color" in attributes:
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
    """Texture (RGBA) and colour of a trimesh material of either kind."""
    image = getattr(material, "baseColorTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if image is None and factor is None:
        image, factor = getattr(material, "image", None), getattr(material, "diffuse", None)
        if image is not None:
            factor = None
    colour = (1.0, 1.0, 1.0) if factor is None else tuple(float(value) for value in _unit(np.asarray(factor)[:3]))
    if image is None:
        return None, colour  # type: ignore[return-value]
    if id(image) not in pictures:
        if max(image.size) > LARGEST_TEXTURE_PX:
            image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
        pictures[id(image)] = np.asarray(image.convert("RGBA"))
    return pictures[id(image)], colour  # type: ignore[return-value]


def _refuse_what_loaders_hide(path: Path, data: bytes, limits: LimitSettings) -> None:
    """The loader passes over textures that aren't there or aren't pictures, and over an OBJ's broken numbers."""
    suffix = path.suffix.lower()
    if suffix in (".gltf", ".glb"):
        check_gltf(path, data, limits=limits)
    elif suffix == ".ply":
        check_counts(path, data, limits=limits)
    elif suffix == ".obj":
        for name in _of_obj(path, data, limits):
            picture = file_of(name, source=path, field="texture")
            if picture is None or not picture.is_file():
                raise InputError(path, "texture", f"{foreign.shown(name, most=200)} is not there")
            held = foreign.read_bytes(
                picture, most_bytes=round(limits.file_mib * foreign.MIB), source=path, field="texture"
            )
            check_picture(held, source=path, field="texture", name=foreign.shown(name, most=200), limits=limits)


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
    """A loaded mesh at its place in the stack frame."""

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
        self._placed = [stack_from_scene] * len(data.parts)
        corners = self._painter.corners_m(self._placed)
        used = {feature for part in data.parts for feature in part.features}
        names = {"PICTURE": "textures", "COLOURED": "vertex colours", "HOLES": "cut-outs"}
        self.info = ContentInfo(
            name=data.name,
            depth_range_m=(float(corners[:, 0].min()), float(corners[:, 0].max())),
            background=background,
            left_out=tuple(text for feature, text in names.items() if feature not in used),
        )

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        return self._painter.paint(view, self._placed)

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        return self._painter.extent(view, self._placed)

    def close(self) -> None:
        self._painter.close()
