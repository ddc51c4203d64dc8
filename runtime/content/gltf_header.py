"""What a glTF or GLB file says of itself, checked before memory is taken for it: counts, nesting, what is missing."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from runtime.config import LimitSettings
from runtime.errors import InputError
from runtime.support import foreign
from runtime.support.picture_header import check_picture

GLB_MAGIC, JSON_CHUNK, BIN_CHUNK = b"glTF", b"JSON", b"BIN\0"
TRIANGLES, STRIP, FAN = 4, 5, 6  # of `mode`
ELEMENTS_PER_TRIANGLE = 10  # all accessors together, for the limit on triangles
UNDERSTOOD = {
    "KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness", "KHR_materials_ior", "KHR_materials_specular",
    "KHR_materials_emissive_strength", "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_transmission",
    "KHR_materials_volume", "KHR_lights_punctual", "EXT_texture_webp", "KHR_mesh_quantization",
    "KHR_texture_transform",
}  # fmt: skip
MOST_INDEX = (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class GltfFile:
    """A file's JSON, once it was checked, and the buffers that it refers to."""

    path: Path
    table: dict[str, Any]
    binary: bytes | None  # a GLB's own buffer
    limits: LimitSettings
    buffers: list[bytes] = field(default_factory=list)
    checked: dict[str, list[dict[str, Any]]] = field(default_factory=dict)  # lists that are known to hold objects

    def refuse(self, field: str, problem: str) -> InputError:
        return InputError(self.path, field, problem)

    def objects(self, key: str) -> list[dict[str, Any]]:
        if key not in self.checked:
            self.checked[key] = _objects(self.table, key, self)
        return self.checked[key]

    def index(self, key: str, index: Any, field: str) -> int:
        """The index of an object that is there. Raises InputError."""
        number = foreign.whole(index, least=0, most=MOST_INDEX, source=self.path, field=field)
        if number >= len(self.objects(key)):
            raise self.refuse(field, f"names {key}[{number}], which is not there")
        return number

    def view_bytes(self, index: Any, field: str) -> tuple[bytes, int]:
        """What a buffer view holds, and its stride (0: none). Raises InputError."""
        view = self.at("bufferViews", index, field)
        start, length = int(view.get("byteOffset", 0)), int(view.get("byteLength", 0))  # known to be whole
        stride = foreign.whole(view.get("byteStride", 0), least=0, most=252, source=self.path, field=f"{field}.stride")
        return self.buffers[int(view["buffer"])][start : start + length], stride

    def at(self, key: str, index: Any, field: str) -> dict[str, Any]:
        """The object that an index names. Raises InputError where it isn't there."""
        return self.objects(key)[self.index(key, index, field)]


def check_gltf(path: Path, data: bytes, *, limits: LimitSettings) -> GltfFile:
    """data: the whole file. Raises InputError, naming the field: over a limit, nested too deep, parts missing."""
    file = _read(path, data, limits)
    required = file.table.get("extensionsRequired", [])
    if isinstance(required, list):
        for name in required:
            if name not in UNDERSTOOD:
                raise file.refuse("extensionsRequired", f"{foreign.shown(name)} is not understood")
    file.buffers.extend(
        _buffer(file, index, item, limits.file_mib * foreign.MIB) for index, item in enumerate(file.objects("buffers"))
    )
    _check_views(file)
    _check_counts(file)
    _check_bones(file)
    _check_pictures(file)
    return file


def _read(path: Path, data: bytes, limits: LimitSettings) -> GltfFile:
    binary = None
    text = data
    if data[:4] == GLB_MAGIC:
        chunks = list(_chunks(path, data))
        if not chunks or chunks[0][0] != JSON_CHUNK:
            raise InputError(path, "", "malformed: a GLB file begins with a chunk of JSON")
        text = chunks[0][1]
        binary = next((held for kind, held in chunks[1:] if kind == BIN_CHUNK), None)
    elif path.suffix.lower() == ".glb":
        raise InputError(path, "", "malformed: not a GLB file")
    table = foreign.parsed_json(text, source=path, most_depth=limits.depth)
    if not isinstance(table, dict):
        raise InputError(path, "", "malformed: a glTF file is a JSON object")
    return GltfFile(path, table, binary, limits)


def _chunks(path: Path, data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of a GLB's chunks. Raises InputError for a file that is cut off."""
    at = 12
    while at + 8 <= len(data):
        size, kind = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
        if at + 8 + size > len(data):
            raise InputError(
                path, "", f"is cut off: a chunk of {size} bytes is promised, {len(data) - at - 8} are there"
            )
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size + (-size % 4)


def _objects(table: dict[str, Any], key: str, file: GltfFile) -> list[dict[str, Any]]:
    items = table.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise file.refuse(key, "must be a list of objects")
    return items


def file_of(uri: str, *, source: Path, field: str) -> Path | None:
    """The file beside `source` that a URI names; None where its data are inside. Raises InputError."""
    if uri.startswith("data:"):
        return None
    if "://" in uri:
        raise InputError(source, field, f"{foreign.shown(uri)}: only files beside this one are read")
    name = foreign.checked_path(unquote(uri), source=source, field=field)
    if name.is_absolute():
        raise InputError(source, field, f"{foreign.shown(uri)} is an absolute path; files beside this one are read")
    return source.parent / name


def _held(file: GltfFile, item: dict[str, Any], field: str, missing: str, most_bytes: float) -> bytes | None:
    """The bytes that an object's URI stands for; None without one. Raises InputError.

    missing: the field that is told where the file is not there.
    """
    uri = item.get("uri")
    if uri is None:
        return None
    if not isinstance(uri, str):
        raise file.refuse(f"{field}.uri", "is not text")
    name = file_of(uri, source=file.path, field=f"{field}.uri")
    if name is not None:
        if not name.exists():
            raise file.refuse(missing, f"{foreign.shown(unquote(uri), most=200)} is not there")
        return foreign.read_bytes(name, most_bytes=round(most_bytes), source=file.path, field=f"{field}.uri")
    head, mark, coded = uri.partition("base64,")
    try:
        return base64.b64decode(coded) if mark else unquote(head).encode()
    except (binascii.Error, ValueError):
        raise file.refuse(f"{field}.uri", "is no base64") from None


def _buffer(file: GltfFile, index: int, item: dict[str, Any], most_bytes: float) -> bytes:
    field = f"buffers[{index}]"
    wanted = foreign.whole(
        item.get("byteLength", 0), least=0, most=1 << 40, source=file.path, field=f"{field}.byteLength"
    )
    data = _held(file, item, field, f"{field}.uri", most_bytes)
    if data is None:
        data = file.binary if index == 0 and file.binary is not None else b""
    if len(data) < wanted:
        raise file.refuse(f"{field}.byteLength", f"{_name(item)}holds {len(data)} bytes, not {wanted}")
    return data


def _name(item: dict[str, Any]) -> str:
    uri = str(item.get("uri", ""))
    return f"{foreign.shown(unquote(uri), most=200)} " if uri and not uri.startswith("data:") else ""


def _check_views(file: GltfFile) -> None:
    for index, view in enumerate(file.objects("bufferViews")):
        field = f"bufferViews[{index}]"
        start, length = (
            foreign.whole(view.get(key, 0), least=0, most=1 << 40, source=file.path, field=f"{field}.{key}")
            for key in ("byteOffset", "byteLength")
        )
        held = len(file.buffers[file.index("buffers", view.get("buffer"), f"{field}.buffer")])
        if start + length > held:
            raise file.refuse(field, f"ends at byte {start + length} of {held}")


def _check_counts(file: GltfFile) -> None:
    """Accessors, triangles, instances and nesting against the limits."""
    limits, total = file.limits, 0
    counts = []
    most = ELEMENTS_PER_TRIANGLE * limits.triangles
    for index, accessor in enumerate(file.objects("accessors")):
        field = f"accessors[{index}].count"
        count = foreign.whole(accessor.get("count"), least=0, most=1 << 40, source=file.path, field=field)
        total += count
        foreign.within(total, most, source=file.path, field=field, limit="10 for each of limits.triangles")
        counts.append(count)
    drawn = [_triangles(file, index, mesh, counts) for index, mesh in enumerate(file.objects("meshes"))]
    stands = _instances(file, len(drawn))
    instances = sum(times * len(drawn[mesh]) for mesh, times in stands.items())
    foreign.within(instances, limits.instances, source=file.path, field="nodes", limit="limits.instances")
    triangles = sum(times * sum(drawn[mesh]) for mesh, times in stands.items())
    held = sum(map(sum, drawn))  # the loader makes those too that stand nowhere
    foreign.within(max(triangles, held), limits.triangles, source=file.path, field="meshes", limit="limits.triangles")


def _triangles(file: GltfFile, index: int, mesh: dict[str, Any], counts: list[int]) -> list[int]:
    """Triangles of each primitive of a mesh."""
    result = []
    for number, primitive in enumerate(_objects(mesh, "primitives", file)):
        field = f"meshes[{index}].primitives[{number}]"
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            raise file.refuse(f"{field}.attributes", "must be an object")
        accessor = primitive.get("indices", attributes.get("POSITION"))
        if accessor is None:
            result.append(0)
            continue
        corners = counts[file.index("accessors", accessor, field)]
        result.append(max(corners - 2, 0) if primitive.get("mode", TRIANGLES) in (STRIP, FAN) else corners // 3)
    return result


def _instances(file: GltfFile, meshes: int) -> dict[int, int]:
    """How often each mesh stands in the scene. Raises InputError for nodes that nest too deep, or in a circle."""
    nodes = file.objects("nodes")
    scenes = file.objects("scenes")
    roots: list[Any] = list(range(len(nodes)))
    if scenes:
        roots = file.at("scenes", file.table.get("scene", 0), "scene").get("nodes", [])
    stands: dict[int, int] = {}
    seen: set[tuple[int, int]] = set()
    queue = [(-1, root, 1) for root in _list(file, roots, "scenes.nodes")]
    while queue:
        parent, child, depth = queue.pop()
        number = file.index("nodes", child, f"nodes[{parent}].children" if parent >= 0 else "scenes.nodes")
        node = file.objects("nodes")[number]
        if depth > file.limits.depth:
            raise file.refuse("nodes", f"are nested deeper than {file.limits.depth} (limits.depth)")
        if (parent, number) in seen:  # as the loader does: each edge once
            continue
        seen.add((parent, number))
        if node.get("mesh") is not None:
            mesh = file.index("meshes", node["mesh"], f"nodes[{number}].mesh")
            stands[mesh] = stands.get(mesh, 0) + 1
        children = _list(file, node.get("children", []), f"nodes[{number}].children")
        queue += [(number, child, depth + 1) for child in children]
    return stands


def _list(file: GltfFile, value: Any, field: str) -> list[Any]:
    if not isinstance(value, list):
        raise file.refuse(field, "must be a list")
    return value


def picture_bytes(file: GltfFile, index: int) -> bytes:
    """The coded picture images[index]. Raises InputError."""
    field, image = f"images[{index}]", file.objects("images")[index]
    data = _held(file, image, field, "texture", file.limits.file_mib * foreign.MIB)
    if data is not None:
        return data
    if "bufferView" not in image:
        raise file.refuse("texture", f"{field} has neither a file nor data")
    return file.view_bytes(image["bufferView"], f"{field}.bufferView")[0]


def _check_bones(file: GltfFile) -> None:
    """What moves: every node of it is worked out for every picture."""
    limits = file.limits
    bones = 0
    for index, skin in enumerate(file.objects("skins")):
        bones += len(_list(file, skin.get("joints"), f"skins[{index}].joints"))
        foreign.within(bones, limits.nodes, source=file.path, field=f"skins[{index}].joints", limit="limits.nodes")
    if file.objects("animations") or bones:
        foreign.within(len(file.objects("nodes")), limits.nodes, source=file.path, field="nodes", limit="limits.nodes")


def _check_pictures(file: GltfFile) -> None:
    """Every picture can be decoded and is within the limit; every texture that a material names is there."""
    for index, image in enumerate(file.objects("images")):
        field = f"images[{index}]"
        if image.get("mimeType") == "image/ktx2":
            raise file.refuse("texture", f"{field} is KTX2, which is not understood; PNG, JPEG or WebP are")
        name = _name(image).rstrip() or field
        check_picture(picture_bytes(file, index), source=file.path, field="texture", name=name, limits=file.limits)
    for index, material in enumerate(file.objects("materials")):
        field = f"materials[{index}]"
        shading = material.get("pbrMetallicRoughness", {})
        wanted = shading.get("baseColorTexture") if isinstance(shading, dict) else None
        if wanted is None:
            continue
        if not isinstance(wanted, dict):
            raise file.refuse(f"{field}.baseColorTexture", "must be an object")
        texture = file.at("textures", wanted.get("index"), f"{field}.baseColorTexture")
        extensions = texture.get("extensions")
        webp = extensions.get("EXT_texture_webp") if isinstance(extensions, dict) else None
        source = webp.get("source") if isinstance(webp, dict) else texture.get("source")
        if source is None:
            raise file.refuse(f"{field}.baseColorTexture", "its texture has no picture that is understood")
        file.at("images", source, f"{field}.baseColorTexture")
