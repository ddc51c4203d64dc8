"""glTF 2.0: triangles with their materials, where their nodes stand, and what moves them.

Read by ourselves, because what moves (animations, skins, morph targets) belongs to the same nodes and vertices; the
file was checked by `gltf_header` before. Colours are taken as code values, as everywhere here.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from runtime.config import LimitSettings
from runtime.content.gltf_header import FAN, STRIP, TRIANGLES, GltfFile, check_gltf, picture_bytes
from runtime.content.rig import Binding, Channel, Node, Rig, Skin
from runtime.content.shapes import I32, Shape
from runtime.content.triangles import Part
from runtime.errors import InputError
from runtime.records import F32, F64, U8
from runtime.support import foreign, progress

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
LARGEST_TEXTURE_PX = 4096
Alpha = Literal["OPAQUE", "MASK", "BLEND"]
Numbers = NDArray[Any]


@dataclass(frozen=True, slots=True)
class GltfScene:
    """Parts in their own frames, and the rig that places them."""

    parts: tuple[Part, ...]
    rig: Rig


@dataclass(frozen=True, slots=True)
class _Material:
    picture: U8 | None = None
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    lit: bool = True
    uv_set: int = 0
    uv_from_uv: F64 | None = None  # 3x3 of KHR_texture_transform


def load_gltf(path: Path, data: bytes, *, limits: LimitSettings, animation: str = "") -> GltfScene:
    """Read a checked file. animation: which one plays, by name or number. Raises InputError."""
    file = check_gltf(path, data, limits=limits)
    return _Reader(file).scene(animation)


class _Reader:
    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._materials: dict[int | None, _Material] = {}
        self._pictures: dict[tuple[int, Alpha, float], U8] = {}

    def scene(self, animation: str) -> GltfScene:
        nodes, order = self._nodes()
        skins = [self._skin(index, item, len(nodes)) for index, item in enumerate(self._file.objects("skins"))]
        channels = self._channels(animation)
        parts: list[Part] = []
        bindings: list[Binding] = []
        tables = self._file.objects("nodes")
        standing = [number for number in order if tables[number].get("mesh") is not None]
        for count, number in enumerate(standing):
            progress.tell(f"{self._file.path.name}: parts", count, len(standing))
            mesh = self._file.index("meshes", tables[number]["mesh"], f"nodes[{number}].mesh")
            skin = tables[number].get("skin")
            held = None if skin is None else skins[self._file.index("skins", skin, f"nodes[{number}].skin")]
            for part, binding in self._primitives(mesh, number, held):
                parts.append(part)
                bindings.append(binding)
        return GltfScene(tuple(parts), Rig(tuple(nodes), tuple(order), tuple(bindings), channels))

    # Numbers.

    def _accessor(self, index: Any, field: str, *, kinds: tuple[str, ...]) -> Numbers:
        """(count, width) numbers; integers that stand for fractions as such."""
        file = self._file
        number = file.index("accessors", index, field)
        table, field = file.objects("accessors")[number], f"accessors[{number}]"
        kind, component = table.get("type"), table.get("componentType")
        if kind not in kinds or kind not in WIDTHS:
            raise file.refuse(f"{field}.type", f"is {foreign.shown(kind)}; {' or '.join(kinds)} is wanted")
        if component not in COMPONENTS:
            raise file.refuse(f"{field}.componentType", f"is {foreign.shown(component)}")
        count = int(table["count"])  # known to be whole
        dtype = np.dtype("<" + COMPONENTS[component])
        if "bufferView" in table:
            values = self._strided(table, table["bufferView"], dtype, count, WIDTHS[kind], field)
        else:
            values = np.zeros((count, WIDTHS[kind]), dtype)
        if isinstance(table.get("sparse"), dict):
            values = self._sparse(values, table["sparse"], dtype, field)
        if table.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return values

    def _strided(
        self, table: dict[str, Any], view: Any, dtype: np.dtype[Any], count: int, width: int, field: str
    ) -> Numbers:
        file = self._file
        data, stride = file.view_bytes(view, f"{field}.bufferView")
        start = foreign.whole(
            table.get("byteOffset", 0), least=0, most=1 << 40, source=file.path, field=f"{field}.byteOffset"
        )
        size = dtype.itemsize * width
        stride = stride or size
        if count and start + (count - 1) * stride + size > len(data):
            raise file.refuse(f"{field}.count", f"its view holds {len(data)} bytes, too few for {count}")
        if not count:
            return np.zeros((0, width), dtype)
        strides = (stride, dtype.itemsize)
        return np.ndarray((count, width), dtype, data, start, strides).copy()

    def _sparse(self, values: Numbers, sparse: dict[str, Any], dtype: np.dtype[Any], field: str) -> Numbers:
        file, field = self._file, f"{field}.sparse"
        count = foreign.whole(sparse.get("count"), least=0, most=len(values), source=file.path, field=f"{field}.count")
        indices, held = sparse.get("indices"), sparse.get("values")
        if not isinstance(indices, dict) or not isinstance(held, dict):
            raise file.refuse(field, "must name indices and values")
        component = indices.get("componentType")
        if component not in (5121, 5123, 5125):
            raise file.refuse(f"{field}.indices.componentType", f"is {foreign.shown(component)}")
        kind = np.dtype("<" + COMPONENTS[component])
        where = self._strided(indices, indices.get("bufferView"), kind, count, 1, f"{field}.indices")[:, 0]
        if count and int(where.max()) >= len(values):
            raise file.refuse(f"{field}.indices", "name elements that are not there")
        values[where] = self._strided(held, held.get("bufferView"), dtype, count, values.shape[1], f"{field}.values")
        return values

    def _floats(self, index: Any, field: str, *, kinds: tuple[str, ...]) -> F32:
        return np.asarray(self._accessor(index, field, kinds=kinds), dtype=np.float32)

    # Nodes.

    def _nodes(self) -> tuple[list[Node], list[int]]:
        """Every node, and the order in which those of the scene can be worked out: parents first."""
        file = self._file
        tables = file.objects("nodes")
        parents: dict[int, int] = {}
        for number, table in enumerate(tables):
            for child in table.get("children", []) or []:
                parents.setdefault(file.index("nodes", child, f"nodes[{number}].children"), number)
        scenes = file.objects("scenes")
        if scenes:
            roots = file.at("scenes", file.table.get("scene", 0), "scene").get("nodes", [])
        else:
            roots = [number for number in range(len(tables)) if number not in parents]
        nodes = [self._node(number, table) for number, table in enumerate(tables)]
        order: list[int] = []
        seen: set[int] = set()
        queue = [(-1, root) for root in reversed(roots)]
        while queue:
            parent, child = queue.pop()
            number = file.index("nodes", child, "scenes.nodes")
            if number in seen:
                continue
            seen.add(number)
            nodes[number] = replace(nodes[number], parent=parent)
            order.append(number)
            queue += [(number, below) for below in reversed(tables[number].get("children", []) or [])]
        return nodes, order

    def _node(self, number: int, table: dict[str, Any]) -> Node:
        field = f"nodes[{number}]"
        if "matrix" in table:
            matrix = self._row(table["matrix"], 16, f"{field}.matrix").reshape(4, 4).T
            return Node(matrix=matrix)
        turn = self._row(table.get("rotation", [0, 0, 0, 1]), 4, f"{field}.rotation")
        moved = self._row(table.get("translation", [0, 0, 0]), 3, f"{field}.translation")
        scale = self._row(table.get("scale", [1, 1, 1]), 3, f"{field}.scale")
        return Node(moved, turn, scale)

    def _row(self, value: Any, count: int, field: str) -> F64:
        if not isinstance(value, list) or len(value) != count:
            raise self._file.refuse(field, f"must be {count} numbers")
        path = self._file.path
        return np.array([foreign.real(item, least=-1e15, most=1e15, source=path, field=field) for item in value])

    # Meshes.

    def _primitives(self, mesh: int, node: int, skin: Skin | None) -> list[tuple[Part, Binding]]:
        table = self._file.objects("meshes")[mesh]
        weights = table.get("weights") or []
        own = self._file.objects("nodes")[node].get("weights")
        rest = self._row(own, len(own), f"nodes[{node}].weights") if isinstance(own, list) and own else None
        if rest is None and isinstance(weights, list) and weights:
            rest = self._row(weights, len(weights), f"meshes[{mesh}].weights")
        result = []
        for number, primitive in enumerate(table.get("primitives", [])):
            made = self._primitive(primitive, f"meshes[{mesh}].primitives[{number}]", node, skin, rest)
            if made is not None:
                result.append(made)
        return result

    def _primitive(
        self, primitive: dict[str, Any], field: str, node: int, skin: Skin | None, rest: F64 | None
    ) -> tuple[Part, Binding] | None:
        file = self._file
        attributes = primitive["attributes"]
        mode = primitive.get("mode", TRIANGLES)
        if "POSITION" not in attributes or mode not in (TRIANGLES, STRIP, FAN):
            return None  # points and lines
        positions = self._floats(attributes["POSITION"], f"{field}.attributes.POSITION", kinds=("VEC3",))
        refuse_broken(positions, file.path)
        triangles = self._triangles(primitive, mode, len(positions), field)
        if not len(triangles):
            return None
        material = self._material(primitive.get("material"), field)

        def attribute(name: str, *kinds: str) -> F32 | None:
            if name not in attributes:
                return None
            values = self._floats(attributes[name], f"{field}.attributes.{name}", kinds=kinds)
            if len(values) != len(positions):
                raise file.refuse(f"{field}.attributes.{name}", f"has {len(values)} of {len(positions)}")
            return values

        uv = attribute(f"TEXCOORD_{material.uv_set}", "VEC2")
        if uv is not None and not np.isfinite(uv).all():
            raise file.refuse("texture coordinates", "are not all finite")
        if uv is not None and material.uv_from_uv is not None:
            uv = np.asarray(uv @ material.uv_from_uv[:2, :2].T + material.uv_from_uv[:2, 2], dtype=np.float32)
        normals = attribute("NORMAL", "VEC3")
        if normals is None or not np.isfinite(normals).all():
            normals = smooth_normals(positions, triangles)
        colours = attribute("COLOR_0", "VEC3", "VEC4")
        part = Part(
            Shape(positions, normals, uv if uv is not None else np.zeros((len(positions), 2), np.float32), triangles),
            picture=material.picture if uv is not None else None,
            colour=material.colour,
            vertex_colours=None if colours is None else np.clip(np.nan_to_num(colours[:, :3]), 0.0, 1.0),
            lit=material.lit,
        )
        return part, self._binding(primitive, attribute, field, node, skin, rest, len(positions))

    def _binding(
        self,
        primitive: dict[str, Any],
        attribute: Callable[..., F32 | None],
        field: str,
        node: int,
        skin: Skin | None,
        rest: F64 | None,
        count: int,
    ) -> Binding:
        """What moves the vertices of a part beside its node."""
        file = self._file
        morphs = []
        for number, target in enumerate(primitive.get("targets") or []):
            if not isinstance(target, dict) or "POSITION" not in target:
                raise file.refuse(f"{field}.targets[{number}]", "moves no positions")
            where = f"{field}.targets[{number}].POSITION"
            moved = self._floats(target["POSITION"], where, kinds=("VEC3",))
            if len(moved) != count or not np.isfinite(moved).all():
                raise file.refuse(where, f"has {len(moved)} of {count}, or some that are not finite")
            morphs.append(moved)
        joints = weights = None
        if skin is not None:
            joints, weights = attribute("JOINTS_0", "VEC4"), attribute("WEIGHTS_0", "VEC4")
            if joints is None or weights is None:
                skin = None
        if skin is not None and joints is not None and weights is not None:
            if not np.isfinite(weights).all() or joints.max(initial=0) >= len(skin.joints):
                raise file.refuse(
                    f"{field}.attributes.JOINTS_0", f"names bones beyond the {len(skin.joints)} there are"
                )
            total = weights.sum(1, keepdims=True)
            weights = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)
            joints = joints.astype(np.int32)
        return Binding(
            node=node,
            skin=skin,
            joints=None if joints is None else np.asarray(joints, dtype=np.int32),
            weights=weights,
            morphs=np.stack(morphs) if morphs else None,
            rest_weights=np.zeros(len(morphs)) if rest is None or len(rest) != len(morphs) else rest,
        )

    def _triangles(self, primitive: dict[str, Any], mode: int, count: int, field: str) -> I32:
        if "indices" in primitive:
            indices = self._accessor(primitive["indices"], f"{field}.indices", kinds=("SCALAR",))[:, 0]
            if indices.dtype.kind != "u":
                raise self._file.refuse(f"{field}.indices", "are no whole numbers from 0 up")
            if len(indices) and int(indices.max()) >= count:
                raise self._file.refuse("faces", "refer to vertices that are not there")
            indices = indices.astype(np.int32)
        else:
            indices = np.arange(count, dtype=np.int32)
        if mode == TRIANGLES:
            return np.ascontiguousarray(indices[: len(indices) // 3 * 3].reshape(-1, 3))
        if len(indices) < 3:
            return np.zeros((0, 3), np.int32)
        if mode == FAN:
            return np.column_stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]]).astype(np.int32)
        strip = np.column_stack([indices[:-2], indices[1:-1], indices[2:]])
        strip[1::2] = strip[1::2, [1, 0, 2]]
        return strip.astype(np.int32)

    # Materials.

    def _material(self, index: Any, field: str) -> _Material:
        if index is None:
            return _Material()
        number = self._file.index("materials", index, f"{field}.material")
        if number not in self._materials:
            self._materials[number] = self._read_material(number)
        return self._materials[number]

    def _read_material(self, number: int) -> _Material:
        file, field = self._file, f"materials[{number}]"
        table = file.objects("materials")[number]
        extensions = _table(table.get("extensions"))
        shading = _table(table.get("pbrMetallicRoughness"))
        wanted, factor = shading.get("baseColorTexture"), shading.get("baseColorFactor")
        other = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if wanted is None and factor is None and isinstance(other, dict):
            wanted, factor = other.get("diffuseTexture"), other.get("diffuseFactor")
        numbers = self._row(factor, 4, f"{field}.baseColorFactor") if factor is not None else np.ones(4)
        red, green, blue, opacity = np.clip(numbers, 0.0, 1.0).tolist()
        result = _Material(colour=(red, green, blue), lit="KHR_materials_unlit" not in extensions)
        if not isinstance(wanted, dict):
            return result
        mode = table.get("alphaMode", "OPAQUE")
        alpha: Alpha = mode if mode in ("MASK", "BLEND") else "OPAQUE"
        cutoff = float(table.get("alphaCutoff", 0.5)) if alpha == "MASK" else 0.5
        texture = file.at("textures", wanted.get("index"), f"{field}.baseColorTexture")
        webp = _table(texture.get("extensions")).get("EXT_texture_webp")
        source = webp.get("source") if isinstance(webp, dict) else texture.get("source")
        image = file.index("images", source, f"{field}.baseColorTexture")
        uv_set = foreign.whole(wanted.get("texCoord", 0), least=0, most=7, source=file.path, field=f"{field}.texCoord")
        change = _table(wanted.get("extensions")).get("KHR_texture_transform")
        moved = self._uv_change(change, field) if isinstance(change, dict) else None
        picture = self._picture(image, alpha, cutoff / opacity if opacity > 0 else 2.0)
        return replace(result, picture=picture, uv_set=uv_set, uv_from_uv=moved)

    def _uv_change(self, table: dict[str, Any], field: str) -> F64:
        field = f"{field}.KHR_texture_transform"
        across, down = self._row(table.get("offset", [0, 0]), 2, f"{field}.offset")
        wide, high = self._row(table.get("scale", [1, 1]), 2, f"{field}.scale")
        turn = self._row([table.get("rotation", 0.0)], 1, f"{field}.rotation")[0]
        cosine, sine = np.cos(turn), np.sin(turn)
        return np.array([[cosine * wide, sine * high, across], [-sine * wide, cosine * high, down], [0.0, 0.0, 1.0]])

    def _picture(self, image: int, alpha: Alpha, cutoff: float) -> U8:
        """RGBA whose alpha is cut at a half, wherever the material cuts it."""
        key = (image, alpha, cutoff)
        if key not in self._pictures:
            rgba = decoded_picture(picture_bytes(self._file, image))
            if alpha == "OPAQUE":
                rgba[..., 3] = 255
            elif cutoff != 0.5:
                rgba[..., 3] = np.clip(rgba[..., 3] * (0.5 / max(cutoff, 1e-3)), 0, 255).astype(np.uint8)
            self._pictures[key] = rgba
        return self._pictures[key]

    # What moves.

    def _skin(self, index: int, table: dict[str, Any], nodes: int) -> Skin:
        field = f"skins[{index}]"
        joints = [self._file.index("nodes", joint, f"{field}.joints") for joint in table["joints"]]
        bound = np.tile(np.eye(4), (len(joints), 1, 1))
        if table.get("inverseBindMatrices") is not None:
            where = f"{field}.inverseBindMatrices"
            held = self._floats(table["inverseBindMatrices"], where, kinds=("MAT4",))
            if len(held) < len(joints) or not np.isfinite(held).all():
                raise self._file.refuse(where, f"has {len(held)} of {len(joints)}, or some that are not finite")
            bound = held[: len(joints)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        return Skin(tuple(joints), bound)

    def _channels(self, animation: str) -> tuple[Channel, ...]:
        """Of the animation that plays; none where there is none."""
        tables = self._file.objects("animations")
        if not tables or animation == "none":
            return ()
        names = [str(table.get("name", "")) for table in tables]
        if not animation:
            number = 0
        elif animation in names:
            number = names.index(animation)
        elif animation.isascii() and animation.isdigit() and int(animation[:9]) < len(tables):
            number = int(animation[:9])
        else:
            known = ", ".join(foreign.shown(name) for name in names[:8])
            raise InputError("content", "animation", f"{animation!r} is none of the {len(tables)} of the file: {known}")
        table, field = tables[number], f"animations[{number}]"
        samplers = table.get("samplers")
        if not isinstance(samplers, list) or not all(isinstance(item, dict) for item in samplers):
            raise self._file.refuse(f"{field}.samplers", "must be a list of objects")
        channels = []
        for index, item in enumerate(table.get("channels") or []):
            made = self._channel(item, samplers, f"{field}.channels[{index}]")
            if made is not None:
                channels.append(made)
        return tuple(channels)

    def _channel(self, item: Any, samplers: list[dict[str, Any]], field: str) -> Channel | None:
        file = self._file
        target = _table(_table(item).get("target"))
        path = target.get("path")
        if target.get("node") is None or path not in ("translation", "rotation", "scale", "weights"):
            return None  # of an extension
        node = file.index("nodes", target["node"], f"{field}.target.node")
        which = foreign.whole(
            _table(item).get("sampler"), least=0, most=max(len(samplers) - 1, 0), source=file.path, field=field
        )
        sampler = samplers[which] if which < len(samplers) else {}
        times = self._floats(sampler.get("input"), f"{field}.input", kinds=("SCALAR",))[:, 0].astype(np.float64)
        if not len(times) or not np.isfinite(times).all() or (np.diff(times) < 0).any() or times[0] < 0:
            raise file.refuse(f"{field}.input", "its times must ascend from 0")
        kind = sampler.get("interpolation", "LINEAR")
        if kind not in ("LINEAR", "STEP", "CUBICSPLINE"):
            raise file.refuse(f"{field}.interpolation", f"is {foreign.shown(kind)}")
        kinds = {"rotation": ("VEC4",), "weights": ("SCALAR",)}.get(path, ("VEC3",))
        values = self._floats(sampler.get("output"), f"{field}.output", kinds=kinds).astype(np.float64)
        keys = len(times) * (3 if kind == "CUBICSPLINE" else 1)
        if not np.isfinite(values).all() or len(values) < keys or len(values) % keys:
            raise file.refuse(f"{field}.output", f"has {len(values)} for {keys}, or some that are not finite")
        width = len(values) // keys if path == "weights" else 1
        if path != "weights" and len(values) != keys:
            raise file.refuse(f"{field}.output", f"has {len(values)} for {keys}")
        shaped = values.reshape(len(times), keys // len(times), width * values.shape[1])
        return Channel(node, path, kind, times, shaped)


def refuse_broken(positions: F32, path: Path) -> None:
    """Raises InputError for vertices that are not finite."""
    broken = int((~np.isfinite(positions).all(1)).sum())
    if broken:
        raise InputError(path, "vertices", f"{broken} of {len(positions)} are not finite")


def smooth_normals(positions: F32, triangles: I32) -> F32:
    """(v, 3) of vertices that have none: the mean of their faces', by area."""
    corner = positions.astype(np.float64)[triangles]
    faces = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    sums = np.zeros((len(positions), 3))
    for place in range(3):
        np.add.at(sums, triangles[:, place], faces)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    found: F32 = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0).astype(np.float32)
    return found


def decoded_picture(coded: bytes) -> U8:
    """(h, w, 4) RGBA, no larger than a texture may be."""
    from PIL import Image

    with Image.open(io.BytesIO(coded)) as image:
        if max(image.size) > LARGEST_TEXTURE_PX:
            image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
        return np.array(image.convert("RGBA"))


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
