"""glTF 2.0: triangles with their materials, where their nodes stand, and what moves them.

Sizes are held to the limits before memory is taken for them, and files beside it are named where they are not
there; anything else that a damaged file provokes here is one line. Colours are taken as code values.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from runtime.content.rig import Binding, Channel, Node, Rig, Skin
from runtime.content.shapes import I32, Shape
from runtime.content.triangles import Part
from runtime.errors import InputError, one_line
from runtime.records import F32, F64, U8
from runtime.support import progress, untrusted_input
from runtime.support.picture_header import decoded_picture
from runtime.support.untrusted_input import LIMITS

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6  # of `mode`; the last two are refused
LARGEST_TEXTURE_PX = 4096
ELEMENTS_PER_TRIANGLE = 10  # all accessors together, for the limit on triangles
UNDERSTOOD = {
    "KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness", "KHR_materials_ior", "KHR_materials_specular",
    "KHR_materials_emissive_strength", "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_transmission",
    "KHR_materials_volume", "KHR_lights_punctual", "EXT_texture_webp", "KHR_mesh_quantization",
    "KHR_texture_transform",
}  # fmt: skip
Numbers = NDArray[Any]
Table = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Look:
    """What a material comes to."""

    picture: U8 | None = None
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    lit: bool = True
    uv_set: int = 0
    uv_from_uv: F64 | None = None  # 3x3


def load_gltf(path: Path, data: bytes, *, animation: str = "") -> tuple[list[Part], Rig]:
    """Parts in their own frames, and the rig that places them. animation: which one plays, by name or number.

    Raises InputError.
    """
    text, binary = data, b""
    if path.suffix.lower() == ".glb" or data[:4] == b"glTF":
        text, binary = _chunks(path, data)
    table = untrusted_input.parsed_json(text, source=path, most_depth=LIMITS.depth)
    try:
        return _Reader(path, table, binary).scene(animation)
    except (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError) as error:
        problem = one_line(f"{type(error).__name__}: {error}", most=120)
        raise InputError(path, "", f"is damaged, or no glTF ({problem})") from None


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the buffer of a GLB. Raises InputError for a file that is cut off."""
    found: dict[bytes, bytes] = {}
    at = 12
    while data[:4] == b"glTF" and at + 8 <= len(data):
        size, kind = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
        if at + 8 + size > len(data):
            there = len(data) - at - 8
            raise InputError(path, "", f"is cut off: a chunk of {size} bytes is promised, {there} are there")
        found.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size + (-size % 4)
    if b"JSON" not in found:
        raise InputError(path, "", "malformed: a GLB file begins with a chunk of JSON")
    return found[b"JSON"], found.get(b"BIN\0", b"")


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


class _Reader:
    def __init__(self, path: Path, table: Table, binary: bytes) -> None:
        """binary: a GLB's own buffer."""
        self._path, self._table, self._binary = path, table, binary
        self._elements = 0  # that were read of all accessors
        self._pixels = 0  # of all textures
        self._decoded: dict[tuple[bytes, float], U8] = {}
        # What several things refer to is read once.
        self._buffer, self._mesh = cache(self._buffer_of), cache(self._mesh_of)
        self._look, self._picture = cache(self._look_of), cache(self._picture_of)

    def scene(self, animation: str) -> tuple[list[Part], Rig]:
        for name in self._table.get("extensionsRequired", []):
            if name not in UNDERSTOOD:
                raise InputError(self._path, "extensionsRequired", f"{untrusted_input.shown(name)} is not understood")
        tables = self._table.get("nodes", [])
        nodes, order = self._nodes(tables)
        bones = [table["joints"] for table in self._table.get("skins", [])]
        if bones or self._table.get("animations"):  # each of them is worked out for every picture
            moving = len(nodes) + sum(map(len, bones))
            self._within(moving, LIMITS.nodes, "nodes and bones")
        skins = [self._skin(table) for table in self._table.get("skins", [])]
        channels = self._channels(animation)
        standing = [number for number in order if "mesh" in tables[number]]
        placed: list[tuple[Part, Binding]] = []
        triangles = 0
        for count, number in enumerate(standing):
            progress.tell(f"{self._path.name}: parts", count, len(standing))
            table = tables[number]
            skin = skins[_index(table["skin"])] if "skin" in table else None
            for part, binding in self._mesh(table["mesh"]):
                triangles += len(part.shape.triangles)
                self._within(triangles, LIMITS.triangles, "meshes")
                placed.append((part, _bound(binding, number, skin)))
            self._within(len(placed), LIMITS.instances, "nodes")
        rig = Rig(tuple(nodes), tuple(order), tuple(binding for _, binding in placed), channels)
        return [part for part, _ in placed], rig

    def _within(self, count: int, most: int, field: str) -> None:
        untrusted_input.within(count, most, source=self._path, field=field)

    def _at(self, key: str, index: Any) -> Table:
        """The object of a list that an index names."""
        found: Table = self._table[key][_index(index)]
        return found

    # Bytes and numbers.

    def _bytes_of(self, item: Table, field: str) -> bytes | None:
        """What an object's URI stands for; None without one."""
        uri = item.get("uri")
        if uri is None:
            return None
        if not uri.startswith("data:"):
            name = file_of(uri, source=self._path, field=field)
            return untrusted_input.read_bytes(name, most_bytes=LIMITS.file_bytes, source=self._path, field=field)
        head, mark, coded = uri.partition("base64,")
        return base64.b64decode(coded) if mark else unquote(head).encode()

    def _buffer_of(self, index: int) -> bytes:
        item = self._at("buffers", index)
        data = self._bytes_of(item, f"buffers[{index}].uri")
        data = self._binary if data is None else data
        if len(data) < item["byteLength"]:
            problem = f"its {len(data)} bytes are fewer than the {item['byteLength']} promised"
            raise InputError(self._path, f"buffers[{index}]", problem)
        return data

    def _view(self, index: Any) -> tuple[bytes, int]:
        """What a buffer view holds, and its stride (0: none)."""
        view = self._at("bufferViews", index)
        start = _index(view.get("byteOffset", 0))
        data = self._buffer(view["buffer"])[start : start + _index(view["byteLength"])]
        return data, _index(view.get("byteStride", 0))

    def _accessor(self, index: Any, *kinds: str) -> Numbers:
        """(count, width) numbers; integers that stand for fractions as such."""
        item = self._at("accessors", index)
        count, width = _index(item["count"]), WIDTHS[item["type"]]
        self._elements += count
        most = ELEMENTS_PER_TRIANGLE * LIMITS.triangles
        self._within(self._elements, most, f"accessors[{index}].count")
        if item["type"] not in kinds:
            raise ValueError(f"accessors[{index}] is {item['type']}, not {' or '.join(kinds)}")
        dtype = np.dtype(COMPONENTS[item["componentType"]])
        values = self._strided(item, dtype, count, width) if "bufferView" in item else np.zeros((count, width), dtype)
        if "sparse" in item:
            sparse = item["sparse"]
            changed, places = _index(sparse["count"]), sparse["indices"]
            where = self._strided(places, np.dtype(COMPONENTS[places["componentType"]]), min(changed, count), 1)[:, 0]
            values[where] = self._strided(sparse["values"], dtype, min(changed, count), width)
        if item.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return values

    def _strided(self, place: Table, dtype: np.dtype[Any], count: int, width: int) -> Numbers:
        data, stride = self._view(place["bufferView"])
        start = _index(place.get("byteOffset", 0))
        if not count:
            return np.zeros((0, width), dtype)
        strides = (stride or dtype.itemsize * width, dtype.itemsize)
        return np.ndarray((count, width), dtype, data, start, strides).copy()

    def _floats(self, index: Any, *kinds: str, count: int | None = None) -> F32:
        """(n, width) finite numbers; count: how many there must be."""
        values = np.asarray(self._accessor(index, *kinds), dtype=np.float32)
        broken = int((~np.isfinite(values).all(1)).sum())
        if broken:
            raise InputError(self._path, f"accessors[{index}]", f"{broken} of {len(values)} are not finite")
        if count is not None and len(values) != count:
            raise ValueError(f"accessors[{index}] has {len(values)} of {count}")
        return values

    # Nodes.

    def _nodes(self, tables: list[Table]) -> tuple[list[Node], list[int]]:
        """Every node, and the order in which those of the scene can be worked out: parents first, each once."""
        if self._table.get("scenes"):
            roots = self._at("scenes", self._table.get("scene", 0)).get("nodes", [])
        else:
            children = {child for table in tables for child in table.get("children", [])}
            roots = [number for number in range(len(tables)) if number not in children]
        nodes = [_node(table) for table in tables]
        order: dict[int, None] = {}
        queue = [(-1, root, 1) for root in reversed(roots)]
        while queue:
            parent, number, depth = queue.pop()
            if depth > LIMITS.depth:
                raise InputError(self._path, "nodes", f"are nested deeper than {LIMITS.depth}")
            if number not in order:
                nodes[_index(number)] = replace(nodes[number], parent=parent)
                order[number] = None
                queue += [(number, child, depth + 1) for child in reversed(tables[number].get("children", []))]
        return nodes, list(order)

    # Meshes.

    def _mesh_of(self, index: Any) -> list[tuple[Part, Binding]]:
        """The parts of a mesh, which all its instances share."""
        mesh = self._at("meshes", index)
        made = [self._primitive(primitive) for primitive in mesh["primitives"]]
        return [item for item in made if item is not None]

    def _primitive(self, primitive: Table) -> tuple[Part, Binding] | None:
        attributes, mode = primitive["attributes"], primitive.get("mode", TRIANGLES)
        if mode in (STRIP, FAN):
            raise InputError(self._path, "mode", "strips and fans of triangles are not read: export triangles")
        if "POSITION" not in attributes or mode != TRIANGLES:
            return None  # points and lines
        positions = self._floats(attributes["POSITION"], "VEC3")
        count = len(positions)
        triangles = self._triangles(primitive, count)
        if not len(triangles):
            return None
        look = self._look(primitive.get("material"))

        def attribute(name: str, *kinds: str) -> F32 | None:
            return self._floats(attributes[name], *kinds, count=count) if name in attributes else None

        uv = attribute(f"TEXCOORD_{look.uv_set}", "VEC2")
        if uv is not None and look.uv_from_uv is not None:
            uv = np.asarray(uv @ look.uv_from_uv[:2, :2].T + look.uv_from_uv[:2, 2], dtype=np.float32)
        normals = attribute("NORMAL", "VEC3")
        if normals is None:
            normals = smooth_normals(positions, triangles)
        colours = attribute("COLOR_0", "VEC3", "VEC4")
        part = Part(
            Shape(positions, normals, uv if uv is not None else np.zeros((count, 2), np.float32), triangles),
            picture=None if uv is None else look.picture,
            colour=look.colour,
            vertex_colours=None if colours is None else np.clip(colours[:, :3], 0.0, 1.0),
            lit=look.lit,
        )
        joints, shares = attribute("JOINTS_0", "VEC4"), attribute("WEIGHTS_0", "VEC4")
        if joints is not None and shares is not None:
            total = shares.sum(1, keepdims=True)
            shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0)
        return part, Binding(
            node=-1,
            joints=None if joints is None or shares is None else joints.astype(np.int32),
            weights=shares,
        )

    def _triangles(self, primitive: Table, count: int) -> I32:
        indices = np.arange(count, dtype=np.int32)
        if "indices" in primitive:
            found = self._accessor(primitive["indices"], "SCALAR")[:, 0]
            if found.dtype.kind != "u" or found.max(initial=0) >= max(count, 1):
                raise InputError(self._path, "faces", "refer to vertices that are not there")
            indices = found.astype(np.int32)
        return np.ascontiguousarray(indices[: len(indices) // 3 * 3].reshape(-1, 3))

    # Materials.

    def _look_of(self, index: Any) -> _Look:
        material = {} if index is None else self._at("materials", index)
        extensions = material.get("extensions", {})
        shading = material.get("pbrMetallicRoughness", {})
        use, factor = shading.get("baseColorTexture"), shading.get("baseColorFactor")
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if use is None and factor is None and glossy is not None:
            use, factor = glossy.get("diffuseTexture"), glossy.get("diffuseFactor")
        red, green, blue, opacity = np.clip(_row(factor or (1, 1, 1, 1), 4), 0.0, 1.0).tolist()
        look = _Look(colour=(red, green, blue), lit="KHR_materials_unlit" not in extensions)
        if use is None:
            return look
        texture = self._at("textures", use["index"])
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            raise InputError(self._path, "textures", "hold a picture in a format that is not understood")
        cutoff = {"MASK": material.get("alphaCutoff", 0.5), "BLEND": 0.5}.get(str(material.get("alphaMode")), 0.0)
        picture = self._picture(source, cutoff / opacity if opacity > 0 else 2.0)
        change = use.get("extensions", {}).get("KHR_texture_transform")
        moved = None if change is None else _uv_change(change)
        return replace(look, picture=picture, uv_set=_index(use.get("texCoord", 0)), uv_from_uv=moved)

    def _picture_of(self, index: Any, cutoff: float) -> U8:
        """RGBA whose alpha is cut at a half, wherever the material cuts it; 0: nowhere."""
        item = self._at("images", index)
        coded = self._bytes_of(item, "texture")
        if coded is None:
            coded = self._view(item["bufferView"])[0]
        key = sha256(coded).digest(), cutoff
        if key in self._decoded:  # several name the same bytes
            return self._decoded[key]
        image = decoded_picture(coded, source=self._path, field="texture", name=f"images[{index}]")
        self._pixels += image.width * image.height
        self._within(self._pixels, LIMITS.texture_pixels, "textures' pixels")
        rgba = self._decoded[key] = texture_of(image)
        rgba[..., 3] = np.clip(rgba[..., 3] * (0.5 / max(cutoff, 1e-3)), 0, 255) if cutoff else 255
        return rgba

    # What moves.

    def _skin(self, table: Table) -> Skin:
        joints = tuple(_index(joint) for joint in table["joints"])
        bound = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in table:
            held = self._floats(table["inverseBindMatrices"], "MAT4").astype(np.float64)
            bound = held[: len(joints)].reshape(len(joints), 4, 4).transpose(0, 2, 1)
        return Skin(joints, bound)

    def _channels(self, animation: str) -> tuple[Channel, ...]:
        """Of the animation that plays; none where there is none."""
        tables = self._table.get("animations", [])
        if not tables or animation == "none":
            return ()
        names = [str(table.get("name", "")) for table in tables]
        numbers = [str(number) for number in range(len(tables))]
        if animation and animation not in (*names, *numbers):
            known = ", ".join(untrusted_input.shown(name) for name in names[:8])
            raise InputError("content", "animation", f"{animation!r} is none of the {len(tables)} of the file: {known}")
        table = tables[names.index(animation) if animation in names else numbers.index(animation or "0")]
        made = [
            self._channel(channel["target"], table["samplers"][channel["sampler"]]) for channel in table["channels"]
        ]
        return tuple(channel for channel in made if channel is not None)

    def _channel(self, target: Table, sampler: Table) -> Channel | None:
        node, path = target.get("node"), target["path"]
        if node is None or path not in ("translation", "rotation", "scale"):
            return None  # morph targets, or of an extension
        times = self._floats(sampler["input"], "SCALAR")[:, 0].astype(np.float64)
        if not len(times) or (np.diff(times) < 0).any() or times[0] < 0:
            raise ValueError("the times of an animation must ascend from 0")
        values = self._floats(sampler["output"], "VEC4" if path == "rotation" else "VEC3")
        kind = sampler.get("interpolation", "LINEAR")
        shape = (len(times), 3 if kind == "CUBICSPLINE" else 1, values.shape[1])
        return Channel(_index(node), path, kind, times, values.astype(np.float64).reshape(shape))


def _index(value: Any) -> int:
    """A whole number from 0 up: lists take negative ones."""
    if not isinstance(value, int) or not 0 <= value < 1 << 40:
        raise ValueError(f"{untrusted_input.shown(value)} is no index, count or size")
    return value


def _row(values: Any, count: int) -> F64:
    row = np.asarray(values, dtype=np.float64)
    if row.shape != (count,) or not (np.abs(row) <= 1e15).all():
        raise ValueError(f"{untrusted_input.shown(values)} must be {count} numbers")
    return row


def _node(table: Table) -> Node:
    if "matrix" in table:
        return Node(matrix=_row(table["matrix"], 16).reshape(4, 4).T)
    turn, scale = _row(table.get("rotation", (0, 0, 0, 1)), 4), _row(table.get("scale", (1, 1, 1)), 3)
    return Node(_row(table.get("translation", (0, 0, 0)), 3), turn, scale)


def _bound(binding: Binding, node: int, skin: Skin | None) -> Binding:
    """A part's binding where it stands."""
    if binding.joints is None:
        skin = None
    elif skin is not None and binding.joints.max(initial=0) >= len(skin.joints):
        raise ValueError(f"JOINTS_0 names bones beyond the {len(skin.joints)} there are")
    return replace(binding, node=node, skin=skin)


def _uv_change(table: Table) -> F64:
    """3x3 of KHR_texture_transform."""
    (across, down), (wide, high) = _row(table.get("offset", (0, 0)), 2), _row(table.get("scale", (1, 1)), 2)
    cosine, sine = np.cos(table.get("rotation", 0.0)), np.sin(table.get("rotation", 0.0))
    return np.array([[cosine * wide, sine * high, across], [-sine * wide, cosine * high, down], [0.0, 0.0, 1.0]])


def smooth_normals(positions: F32, triangles: I32) -> F32:
    """(v, 3) of vertices that have none: the mean of their faces'."""
    import trimesh

    return np.asarray(trimesh.Trimesh(positions, triangles, process=False).vertex_normals, np.float32)


def texture_of(image: Any) -> U8:
    """(h, w, 4) RGBA of a Pillow image, no larger than a texture may be."""
    if max(image.size) > LARGEST_TEXTURE_PX:
        image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
    return np.array(image.convert("RGBA"))
