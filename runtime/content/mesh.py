"""Read meshes from glTF, GLB, OBJ, OFF, PLY and STL files."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from runtime.content.base import ContentInfo, ContentSource
from runtime.content.gaussians import LARGEST_COORDINATE, Gaussians, bounds, of_points
from runtime.content.gltf import GltfScene
from runtime.content.gltf_splats import together
from runtime.content.parts import OUTLINED_MAX, UNCOLOURED, Part, merged
from runtime.content.placing import GLTF, SceneFile
from runtime.content.ply import read_header
from runtime.content.shapes import AT_ONCE, Origin, Shape, flat_normals
from runtime.content.splat import SplatSource
from runtime.content.triangles import DrawnPart, TriangleSource
from runtime.errors import InputError
from runtime.records import F32, F64
from runtime.support import progress, untrusted_input
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.content")

STL_HEAD, STL_FACET = 84, 50  # sizes of a binary file's header and of each triangle, in bytes
UNREAD = ("tristrips", "edge")  # PLY elements that are not drawn
OFF_COUNTS = re.compile(rb"^\s*[A-Z4n]*OFF\s+(?:#.*\s+)*(\d{1,18})\s+(\d{1,18})")


@dataclass(frozen=True, slots=True)
class MeshData:
    """Triangles, or points and splats, from a mesh file, in the file's coordinates relative to `origin`."""

    parts: tuple[Part, ...]
    points: tuple[tuple[F32, F32], ...]  # positions (n, 3) and colours (n, 3); empty if there are parts
    origin: F64  # (3,) in the file's coordinates; zero unless the content is far from there
    low: F64  # (3,) lowest corner of the visible content, in the file's coordinates
    high: F64  # (3,) highest corner
    facing: F64  # (3,) area-weighted mean normal; the length is at most 1, and 0 for a closed surface
    splats: tuple[Gaussians, ...] = ()  # relative to `origin`; empty if there are parts
    left_out: tuple[str, ...] = ()  # features in the file that are not drawn


def prepare(file: SceneFile) -> Callable[..., ContentSource]:
    """Read a mesh file, and return a function that creates the source in a GL context. Raises InputError
    if that fails. The edges of small meshes are found at this stage, because doing so needs no GL context.
    """
    data = load_mesh(file.path)
    if data.left_out:
        log.warning("%s: not drawing %s", file.path, ", ".join(data.left_out))
    info = ContentInfo(file.path.stem, background=file.background, left_out=data.left_out)
    matrix = file.placed(data.low, data.high, facing=data.facing)
    matrix[:3, 3] += matrix[:3, :3] @ data.origin
    if not data.parts:
        points = [of_points(*map(np.concatenate, zip(*data.points, strict=True)))] if data.points else []
        splats = together([*data.splats, *points])
        return partial(SplatSource, splats, stack_from_scene=matrix, info=info)
    parts = []
    alike = merged(data.parts)
    is_small = sum(len(part.shape.triangles) for part in alike) <= OUTLINED_MAX
    for number, part in enumerate(alike):
        progress.tell(f"{file.path.name}: outlines", number, len(alike))
        parts.append(DrawnPart(part, outlined=is_small))
    return partial(TriangleSource, parts, [matrix] * len(parts), info=info)


def load_mesh(path: Path) -> MeshData:
    """Read a mesh file. Raises InputError if it is damaged, empty, not finite or exceeds a limit."""
    progress.tell(f"reading {path.name}", 0)
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    _check_counts(path, data)
    parts: list[Part] = []
    points: list[tuple[F32, F32]] = []
    splats: list[Gaussians] = []
    left_out: set[str] = set()
    origin = Origin()
    with np.errstate(all="ignore"):  # `_check` reports coordinates that overflow
        if path.suffix.lower() == ".ply":
            left_out = {name for name, count in read_header(path).counts.items() if count and name in UNREAD}
        elif path.suffix.lower() == ".off" and data.lstrip().startswith(b"COFF"):
            left_out = {"colours"}
        if _is_binary_stl(path, data):
            parts = [_binary_stl(data, origin)]
        elif path.suffix.lower() in GLTF:
            scene = GltfScene(path, data, folder_reader(path, "uri"), origin)
            parts, points, left_out, splats = scene.parts, scene.points, scene.left_out, scene.splats
        else:
            from runtime.content.other_meshes import read_mesh

            parts, points = read_mesh(path, data, folder_reader(path, "texture"), origin)
    triangles = sum(len(part.shape.triangles) for part in parts)
    untrusted_input.within(triangles, LIMITS.triangles, source=path, field="faces")
    untrusted_input.within(sum(len(place) for place, _ in points), LIMITS.splats, source=path, field="points")
    if parts and points:
        left_out, points = left_out | {"points and lines"}, []
    if parts and splats:
        left_out, splats = left_out | {"splats"}, []
    places = [
        *(one.centres for one in splats),
        *(part.shape.positions_m for part in parts),
        *(place for place, _ in points),
    ]
    _check(path, parts, places, left_out)
    total, area = np.zeros(3), 0.0
    ends = [end for place, _ in points for end in (place.min(0), place.max(0))]
    ends += [end for one in splats for end in bounds(one)]
    for part in parts:
        for first in range(0, len(part.shape.triangles), AT_ONCE):
            corner = part.shape.positions_m[part.shape.triangles[first : first + AT_ONCE]].astype(np.float64)
            normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            areas = np.linalg.norm(normal, axis=1)
            total, area = total + normal.sum(0), area + float(areas.sum())
            if areas.any():  # triangles without area are not visible, such as those of an object of scale 0
                ends += [end(corner[areas > 0], (0, 1)) for end in (np.min, np.max)]
    if parts and not area:
        raise InputError(path, "faces", "all faces have zero area")
    shift = np.zeros(3) if origin.point is None else origin.point
    low, high = (np.asarray(end(ends, 0), np.float64) + shift for end in (np.min, np.max))
    said = tuple(untrusted_input.shown(name) for name in sorted(left_out))
    return MeshData(tuple(parts), tuple(points), shift, low, high, total / (area or 1.0), tuple(splats), said)


def folder_reader(path: Path, field: str) -> Callable[[str], bytes]:
    """Return a function that reads, once, the files a mesh refers to by URI or path; `field` names the
    kind of reference. It raises InputError if a reference is not a relative path to a readable file in the mesh's
    folder or below.
    """
    read_files: dict[str, bytes] = {}

    def read(name: str) -> bytes:
        if name not in read_files:
            place = _file_of(name, source=path, field=field)
            read_files[name] = untrusted_input.read_bytes(place, most_bytes=LIMITS.file_bytes, source=path, field=field)
        return read_files[name]

    return read


def _file_of(uri: str, *, source: Path, field: str) -> Path:
    """Return the path of the file that a URI or relative path in the file `source` refers to. Raises InputError if the
    URI has a scheme, the path is absolute or leads out of the folder, or the file is missing.
    """
    shown = untrusted_input.shown(uri, most=200)
    if "://" in uri or uri.startswith("data:"):
        raise InputError(
            source, field, f"{shown} is not a local file; only files in this file's folder or below it are read"
        )
    name = untrusted_input.path_within_folder(unquote(uri).replace("\\", "/"), source=source, field=field)
    found = untrusted_input.spelled(source.parent, name)
    if found is None:
        raise InputError(source, field, f"{shown} does not exist")
    return found


def _check(path: Path, parts: Sequence[Part], places: Sequence[F32], left_out: set[str]) -> None:
    """Raise InputError if there is nothing to draw, or if any coordinate is not finite or too large."""
    if not any(len(place) for place in places):
        alone = f", and {' and '.join(sorted(left_out))} are not supported" if left_out else ""
        raise InputError(path, "faces", f"the file contains no faces{alone}")
    for points in places:
        broken = int((~(np.abs(points) <= LARGEST_COORDINATE).all(1)).sum())  # also counts NaN
        if broken:
            problem = f"{broken} of {len(points)} vertices are not finite or exceed {LARGEST_COORDINATE:g}"
            raise InputError(path, "vertices", problem)
    for part in parts:
        if not np.isfinite(part.shape.uv).all():
            raise InputError(path, "texture coordinates", "some texture coordinates are not finite")


def _check_counts(path: Path, data: bytes) -> None:
    """Raise InputError if a file declares too many elements, before a loader allocates memory for them."""
    suffix, promised = path.suffix.lower(), 0
    if suffix == ".ply":
        read_header(path)
    elif suffix == ".stl":
        text = data[:5] == b"solid" and b"facet normal" in data[:1024]
        promised = data.count(b"facet normal") if text else (len(data) - STL_HEAD) // STL_FACET
    elif suffix == ".obj":
        promised = data.count(b"\nf ")
    elif counts := OFF_COUNTS.match(data[:4096]) if suffix == ".off" else None:
        promised = max(int(counts[2]), int(counts[1]) // 3)
    untrusted_input.within(promised, LIMITS.triangles, source=path, field="faces")


def _is_binary_stl(path: Path, data: bytes) -> bool:
    count = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little")
    return path.suffix.lower() == ".stl" and count > 0 and len(data) == STL_HEAD + count * STL_FACET


def _binary_stl(data: bytes, origin: Origin) -> Part:
    """Read a binary STL file without trimesh, which needs ten times the memory for the largest files."""
    facets = np.frombuffer(data, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")], offset=STL_HEAD)
    corners = np.concatenate(
        [
            origin.relative(facets["corners"][first : first + AT_ONCE]).astype(np.float32)
            for first in range(0, len(facets), AT_ONCE)
        ]
    )
    triangles = np.arange(3 * len(facets), dtype=np.int32).reshape(-1, 3)
    normals, uv = np.repeat(flat_normals(corners), 3, axis=0), np.zeros((triangles.size, 2), np.float32)
    return Part(Shape(corners.reshape(-1, 3), normals, uv, triangles), colour=UNCOLOURED)
