"""Checks of a glTF file's declared sizes and textures against the limits, before trimesh loads it.

trimesh passes over a texture that it cannot read; here that is an error that names it.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from runtime.errors import InputError, one_line
from runtime.records import U8
from runtime.support import untrusted_input
from runtime.support.picture_header import check_size, decoded_picture, picture_size
from runtime.support.untrusted_input import LIMITS

ELEMENTS_PER_TRIANGLE = 10  # all accessors together, for the limit on triangles
UNDERSTOOD = {  # of what a file may require; the rest is drawn without
    "KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness", "KHR_materials_ior", "KHR_materials_specular",
    "KHR_materials_emissive_strength", "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_transmission",
    "KHR_materials_volume", "KHR_lights_punctual", "EXT_texture_webp",
}  # fmt: skip
Table = dict[str, Any]
Read = Callable[[str], bytes]  # the file beside it that a URI names


def check_gltf(path: Path, data: bytes, read: Read) -> None:
    """Raises InputError for a file over the limits, a texture that is no picture, or no glTF at all."""
    text, binary = (data, b"") if data[:4] != b"glTF" else _chunks(path, data)
    table = untrusted_input.parsed_json(text, source=path, most_depth=LIMITS.depth)
    try:
        _check(path, table, binary, read)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        problem = one_line(f"{type(error).__name__}: {error}", most=120)
        raise InputError(path, "", f"is damaged, or no glTF ({problem})") from None


def file_of(uri: str, *, source: Path, field: str) -> Path:
    """The file beside `source` that a URI names. Raises InputError."""
    if "://" in uri or uri.startswith("data:"):
        raise InputError(source, field, f"{untrusted_input.shown(uri)}: only files beside this one are read")
    name = untrusted_input.checked_path(unquote(uri), source=source, field=field)
    if name.is_absolute():
        raise InputError(
            source, field, f"{untrusted_input.shown(uri)} is an absolute path; files beside this one are read"
        )
    if not (source.parent / name).exists():
        raise InputError(source, field, f"{untrusted_input.shown(str(name), most=200)} is not there")
    return source.parent / name


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the buffer of a GLB."""
    size = int.from_bytes(data[12:16], "little")
    if data[16:20] != b"JSON" or len(data) < 20 + size:
        raise InputError(path, "", "is cut off, or malformed: a GLB file begins with a chunk of JSON")
    return data[20 : 20 + size], data[20 + size + 8 :]


def _check(path: Path, table: Table, binary: bytes, read: Read) -> None:
    for name in table.get("extensionsRequired", []):
        if name not in UNDERSTOOD:
            raise InputError(path, "extensionsRequired", f"{untrusted_input.shown(name)} is not understood")
    elements = 0
    for number, accessor in enumerate(table.get("accessors", [])):
        elements += int(accessor["count"])
        most = ELEMENTS_PER_TRIANGLE * LIMITS.triangles
        untrusted_input.within(elements, most, source=path, field=f"accessors[{number}].count")
    nodes = table.get("nodes", [])
    _check_depth(path, nodes, table.get("scenes", []))
    placed = [node["mesh"] for node in nodes if "mesh" in node]
    untrusted_input.within(len(placed), LIMITS.instances, source=path, field="nodes")
    triangles = [_triangles(table, mesh) for mesh in table.get("meshes", [])]
    untrusted_input.within(sum(triangles[index] for index in placed), LIMITS.triangles, source=path, field="meshes")
    numbers = sorted({_source(path, table, texture) for texture in _drawn_textures(table)})
    coded = {number: _coded(table, table["images"][number], binary, read) for number in numbers}
    pixels = 0
    for number, picture in coded.items():  # by their headers, before one is decoded
        with suppress(ValueError):
            size = picture_size(picture)
            check_size(*size, source=path, field="texture", name=f"images[{number}]", head=picture)
            pixels += math.prod(size)
        untrusted_input.within(pixels, LIMITS.texture_pixels, source=path, field="textures' pixels")
    for number, picture in coded.items():
        decoded_picture(picture, source=path, field="texture", name=f"images[{number}]")


def _drawn_textures(table: Table) -> Iterator[Table]:
    """The textures of base colours; others, of normals and the like, are not drawn."""
    for material in table.get("materials", []):
        glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        for use in filter(None, (base, glossy.get("diffuseTexture"))):
            yield table["textures"][use["index"]]


def _source(path: Path, table: Table, texture: Table) -> int:
    """The number of a texture's image."""
    source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
    if source is None:
        raise InputError(path, "textures", "hold a picture in a format that is not understood")
    number: int = range(len(table["images"]))[source]
    return number


def _check_depth(path: Path, nodes: list[Table], scenes: list[Table]) -> None:
    seen: set[int] = set()
    queue = [(root, 1) for scene in scenes for root in scene.get("nodes", [])]
    while queue:
        number, depth = queue.pop()
        if depth > LIMITS.depth:
            raise InputError(path, "nodes", f"are nested deeper than {LIMITS.depth}")
        if number not in seen:
            seen.add(number)
            queue += [(child, depth + 1) for child in nodes[number].get("children", [])]


def _triangles(table: Table, mesh: Table) -> int:
    total = 0
    for primitive in mesh["primitives"]:
        index = primitive.get("indices", primitive["attributes"].get("POSITION"))
        total += 0 if index is None else int(table["accessors"][index]["count"]) // 3
    return total


def _coded(table: Table, item: Table, binary: bytes, read: Read) -> bytes:
    """A coded picture's bytes: embedded in the JSON, in a buffer, or in a file beside."""
    if "uri" in item:
        return _of_uri(item["uri"], read)
    view = table["bufferViews"][item["bufferView"]]
    buffer = table["buffers"][view["buffer"]]
    data = _of_uri(buffer["uri"], read) if "uri" in buffer else binary
    start = int(view.get("byteOffset", 0))
    return data[start : start + int(view["byteLength"])]


def _of_uri(uri: str, read: Read) -> bytes:
    mark = "base64,"
    return base64.b64decode(uri.partition(mark)[2]) if mark in uri else read(uri)


def cut_alpha(rgba: U8, material: Any) -> None:
    """Rescale a trimesh material's alpha (h, w, 4) in place so that its cut-off is one half."""
    cut = {"MASK": 0.5 if material.alphaCutoff is None else material.alphaCutoff, "BLEND": 0.5}
    cutoff = cut.get(str(material.alphaMode), 0.0)
    opacity = 1.0 if material.baseColorFactor is None else float(material.baseColorFactor[3]) / 255
    cutoff = cutoff / opacity if opacity > 0 else 2.0
    rgba[..., 3] = np.clip(rgba[..., 3] * (0.5 / max(cutoff, 1e-3)), 0, 255) if cutoff else 255
