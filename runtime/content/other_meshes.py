"""Read OBJ, OFF, PLY and STL files with trimesh, and convert them to parts or points."""

from __future__ import annotations

import codecs
import io
import itertools
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from runtime.content.base import WHITE, Colour
from runtime.content.gaussians import dotted
from runtime.content.gltf_file import Read
from runtime.content.parts import UNCOLOURED, Part, texture_of
from runtime.content.ply import read_header
from runtime.content.shapes import Origin, Shape, placed
from runtime.errors import InputError
from runtime.records import F32, F64, U8
from runtime.support import progress, untrusted_input
from runtime.support.picture_header import decoded_picture
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.content")

BOMS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# Options that precede a texture's name in an MTL file, such as `-s 1 1 1`, `-blendu off` or `-imfchan r`.
OPTIONS = re.compile(
    r"(?:-[a-zA-Z]+(?:\s+(?:on|off|[rgbmlz]|sRGB|linear|sphere|cube_\w+|[-+.\d]+(?:[eE][-+]?\d+)?)(?=\s))*\s+)+"
)
BEHIND_NUMBERS = re.compile(r"^([ \t]*(?:v|vt|vn|vp|f|l|p)[ \t][^#\n]*)#.*", re.MULTILINE)  # comment in an OBJ file
COLOURED = re.compile(r"^v(?:[ \t]+[^\s#]+){6}", re.MULTILINE)
UNCOLOURED_VERTEX = re.compile(r"^v(?:[ \t]+[^\s#]+){3}(?=[ \t\r]*$)", re.MULTILINE)
COUNTS_BACK = re.compile(r"^[fl][ \t].*-", re.MULTILINE)
BACKWARDS = re.compile(r"-[0-9]{1,9}")
LIBRARIES = re.compile(r"^[ \t]*mtllib[ \t]+(.*\S)", re.MULTILINE)
BETWEEN_LIBRARIES = re.compile(r"(?<=\.mtl)\s+", re.IGNORECASE)
DRIVE = re.compile(r"[A-Za-z]:.*/")  # folder on the author's Windows machine, which is stripped from paths


class FolderResolver(trimesh.resolvers.FilePathResolver):
    """Resolver that trimesh's loaders use to read the files a mesh refers to. A missing material file is
    replaced by an empty file, and a missing texture by a grey one. Other problems are stored in `refused`, because the
    loaders discard exceptions.
    """

    def __init__(self, path: Path, read: Read, *, libraries: list[str], has_texture: bool) -> None:
        """Read with `read`. `libraries`: all material files, of which trimesh would ask for the first line's alone."""
        super().__init__(str(path))
        self._path, self._read, self._pixels, self._libraries = path, read, 0, libraries
        self.refused: InputError | None = None
        self.has_materials = has_texture

    def get(self, name: str) -> bytes:
        if name.lower().endswith(".mtl"):
            return b"\n".join(self._get(library, is_material=True) for library in self._libraries)
        return self._get(name, is_material=False)

    def _get(self, name: str, *, is_material: bool) -> bytes:
        try:
            file_name = self._named(name)
            if file_name is None:
                what = "materials" if is_material else "texture"
                why = f"{untrusted_input.shown(name)} does not exist"
                log.warning("%s: drawing the mesh in grey without its %s because %s", self._path, what, why)
                return b"" if is_material else _grey()
            data = self._read(file_name)
            self.has_materials |= is_material
            if not is_material:
                image = decoded_picture(data, source=self._path, field="texture", name=untrusted_input.shown(name))
                self._pixels += image.width * image.height
                most = LIMITS.texture_pixels
                untrusted_input.within(self._pixels, most, source=self._path, field="textures' pixels")
        except InputError as error:
            self.refused = error
            raise
        return data

    def _named(self, name: str) -> str | None:
        """Return the name of a file in the mesh's folder, which may come with MTL options or as a Windows path, or
        None. Raises InputError if the name is an absolute path or leads out of the folder.
        """
        name = DRIVE.sub("", OPTIONS.sub("", name, count=1).strip().replace("\\ ", " ").replace("\\", "/"))
        within = untrusted_input.path_within_folder(name, source=self._path, field="texture")
        found = untrusted_input.spelled(self._path.parent, within)
        return None if found is None else str(found.relative_to(self._path.parent))


def read_mesh(path: Path, data: bytes, read: Read, origin: Origin) -> tuple[list[Part], list[tuple[F32, F32]]]:
    """Convert a mesh file's triangles to parts, and its points or lines to positions (n, 3) and colours
    (n, 3). `read` reads other files; `origin` is subtracted. Raises InputError if a file is damaged or missing.
    """
    kind = path.suffix.lower().removeprefix(".")
    progress.tell(f"{path.name}: triangles", 0)
    text = _text(data) if kind == "obj" else ""
    libraries = [name for line in LIBRARIES.findall(text) for name in BETWEEN_LIBRARIES.split(line)]
    resolver = FolderResolver(path, read, libraries=libraries, has_texture=kind == "ply" and b"TextureFile" in data)
    try:
        data = _joined(data) if kind == "off" else _without_comments(path, kind, data)
        file = io.StringIO(text) if kind == "obj" else io.BytesIO(data)
        scene = trimesh.load_scene(file, file_type=kind, resolver=resolver, process=False)
        meshes = [(scene.geometry[name], matrix) for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)]
        has_faces = any(len(getattr(mesh, "faces", ())) for mesh, _ in meshes)
        wires = _wires(file, origin) if isinstance(file, io.StringIO) and not has_faces else None
    except Exception as error:  # trimesh's loaders raise various errors
        if resolver.refused is not None:
            raise resolver.refused from None
        why = (
            "a face refers to a vertex that does not exist"
            if isinstance(error, IndexError)
            else "the file is damaged or is not a mesh"
        )
        raise InputError(path, "", f"cannot be read as a mesh: {why}") from None
    if resolver.refused is not None:
        raise resolver.refused
    pictures: dict[int, U8] = {}
    parts, points = [], []
    for mesh, matrix in meshes:
        if not len(getattr(mesh, "faces", ())):
            points += _points(mesh, origin)
            continue
        if mesh.visual.kind == "texture" and not resolver.has_materials:  # drop the loader's default grey
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=mesh.visual.vertex_attributes.get("color"))
        parts.append(_part(mesh, matrix, path, pictures, origin))
    return parts, points if wires is None else [dotted(wires, np.full_like(wires, np.nan))]


def _without_comments(path: Path, kind: str, data: bytes) -> bytes:
    """Remove comments and blank lines between a PLY or STL file's numbers, because trimesh fails at them."""
    if kind == "stl" and b"\0" not in data[:1024]:
        return re.sub(rb"#.*", b"", data)
    if kind == "ply" and (header := read_header(path)).order == "ascii":
        start = header.starts_at
        return data[:start] + re.sub(rb"^[ \t\r]*(?:comment.*)?(?:\n|$)", b"", data[start:], flags=re.MULTILINE)
    return data


def _joined(data: bytes) -> bytes:
    """Write each vertex and each face of an OFF file on one line, as trimesh expects them."""
    kind, mark, numbers = re.sub(rb"#.*", b"", data).partition(b"OFF")
    lines = [words for line in numbers.splitlines() if (words := line.split())]
    records, record = [b" ".join(lines[0])] if lines else [], list[bytes]()
    for words in lines[1:]:
        record += words
        if len(record) > (2 if len(records) <= int(lines[0][0]) else int(record[0])):
            records.append(b" ".join(record))
            record = []
    if record and len(records) <= sum(map(int, lines[0][:2])):
        raise EOFError
    return kind + mark + b"\n" + b"\n".join(records) if records else data


def _text(data: bytes) -> str:
    """Decode an OBJ file, UTF-16 or UTF-8, and replace invalid characters of names, and what trimesh misunderstands:
    comments behind numbers, vertices without colours among others, and numbers that count back from their line.
    """
    text = BEHIND_NUMBERS.sub(r"\1", data.decode("utf-16" if data[:2] in BOMS else "utf-8", errors="replace"))
    if COLOURED.search(text):
        text = UNCOLOURED_VERTEX.sub(rf"\g<0> {' '.join(map(str, UNCOLOURED))}", text)
    return _counted(text.replace("\\\n", " ")) if COUNTS_BACK.search(text) else text


def _counted(text: str) -> str:
    """Number the vertices of faces and lines from the OBJ file's start where they are numbered from their line."""
    lines, counts = text.splitlines(), dict.fromkeys(("v", "vt", "vn"), 0)
    for place, line in enumerate(lines):
        kind, *corners = line.split() or [""]
        if kind in counts:
            counts[kind] += 1
        elif kind in ("f", "l") and "-" in line:
            total = tuple(counts.values())
            numbers = [zip(corner.split("/"), total, strict=False) for corner in corners]
            ends = ["/".join(_from_start(at, count) for at, count in corner) for corner in numbers]
            lines[place] = " ".join([kind, *ends])
    return "\n".join(lines)


def _from_start(number: str, count: int) -> str:
    """Number a vertex from the first instead of back from the last of `count`; anything else stays."""
    return str(count + 1 + int(number)) if BACKWARDS.fullmatch(number) else number


def _wires(file: io.StringIO, origin: Origin) -> F32 | None:
    """Return the ends (n, 2, 3) of the lines in an OBJ file, or None if it contains no lines."""
    places: list[list[str]] = []
    ends: list[tuple[int, int]] = []
    for kind, *words in filter(None, map(str.split, file.getvalue().splitlines())):
        if kind == "v":
            places.append(words[:3])
        elif kind == "l":
            numbers = [int(word.partition("/")[0]) for word in words]
            corners = [number - 1 if number > 0 else len(places) + number for number in numbers]
            ends += itertools.pairwise(corners)
    return origin.relative(np.array(places, np.float64))[np.array(ends)].astype(np.float32) if ends else None


def _grey() -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (1, 1), tuple(round(255 * value) for value in UNCOLOURED)).save(file, "PNG")
    return file.getvalue()


def _points(cloud: Any, origin: Origin) -> list[tuple[F32, F32]]:
    vertices = np.asarray(getattr(cloud, "vertices", np.empty((0, 3))))
    if not len(vertices) or vertices.shape[1:] != (3,) or not hasattr(cloud, "colors"):
        return []
    places = origin.relative(vertices).astype(np.float32)
    colours = np.asarray(cloud.colors)
    return [(places, _unit(colours)[:, :3] if len(colours) == len(places) else np.full_like(places, np.nan))]


def _part(mesh: Any, matrix: F64, path: Path, pictures: dict[int, U8], origin: Origin) -> Part:
    """Convert a trimesh mesh to a part with a material, with vertex or face colours, or in plain grey.
    `pictures`: the textures converted so far, by their material's `id`; updated. Raises InputError.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, "faces", "some faces refer to vertices that do not exist or have no z coordinate")
    visual, kind = mesh.visual, mesh.visual.kind
    picture, colour, opacity, colours = None, UNCOLOURED, 1.0, None
    if kind == "texture":
        picture, colour, opacity = _material(visual.material, pictures)
        colours = visual.vertex_attributes.get("color")
        if path.suffix.lower() == ".ply":  # PLY has no materials, but trimesh adds a coloured material
            colour = WHITE
    elif kind == "vertex":
        colours, colour = visual.vertex_colors, WHITE
    elif kind == "face":
        colours, colour = np.repeat(visual.face_colors, 3, axis=0), WHITE
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    normals = np.repeat(mesh.face_normals, 3, axis=0) if kind == "face" else mesh.vertex_normals
    uv = np.zeros((len(vertices), 2), np.float32)
    if picture is None or visual.uv is None:
        picture = None
    else:
        uv = np.column_stack([visual.uv[:, 0], 1.0 - visual.uv[:, 1]]).astype(np.float32)
    positions, turned = placed(vertices, normals, matrix, origin=origin)
    assert turned is not None
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    shape = Shape(positions, turned, uv, faces.astype(np.int32))
    alpha = "blend" if opacity < 1 else "mask"
    colours = None if colours is None else _unit(colours)[:, :3]
    return Part(shape, picture, colour, colours, opacity=opacity, alpha=alpha)  # type: ignore[arg-type]


def _unit(colours: Any) -> F32:
    """Convert colours (n, 3 or 4) from integers or fractions to float32 in [0, 1]."""
    numbers = np.asarray(colours)
    scale = np.float32(np.iinfo(numbers.dtype).max if numbers.dtype.kind == "u" else 1.0)
    return np.asarray(np.clip(numbers.astype(np.float32) / scale, 0.0, 1.0), dtype=np.float32)


def _material(material: Any, pictures: dict[int, U8]) -> tuple[U8 | None, Colour, float]:
    """Return a material's RGBA texture, the colour that multiplies the texture, and the opacity. Black with a texture
    is treated as white, which some exporters write for materials that consist only of a texture.
    """
    image, diffuse = getattr(material, "image", None), getattr(material, "diffuse", None)
    red, green, blue = _unit(np.ones(3) if diffuse is None else diffuse)[:3].tolist()
    opacity = _opacity(getattr(material, "kwargs", {}))
    if image is None:
        return None, UNCOLOURED if diffuse is None else (red, green, blue), opacity
    if id(material) not in pictures:
        pictures[id(material)] = texture_of(image)
    return pictures[id(material)], (red, green, blue) if red or green or blue else WHITE, opacity


def _opacity(fields: dict[str, Any]) -> float:
    """Return the opacity of a material from an MTL file: `d`, or 1 - `Tr`; 1 if it is missing, invalid or 0."""
    for name, sign, start in (("d", 1.0, 0.0), ("tr", -1.0, 1.0)):
        try:
            value = start + sign * float(fields[name][-1])
        except (LookupError, TypeError, ValueError):
            continue
        if 0.0 < value <= 1.0:
            return value
    return 1.0
