"""Convert a glTF 2.0 scene's nodes, primitives and materials to parts, without its animations."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from runtime.content import gltf_splats
from runtime.content.base import WHITE
from runtime.content.gaussians import Gaussians, dotted
from runtime.content.gltf_file import COMPRESSED, WAY_OUT, Array, GltfFile, Read, Table, fractions
from runtime.content.parts import BLACK, Part, Sampler, Wrap, coded
from runtime.content.shapes import Origin, Shape, flat_normals, placed
from runtime.errors import InputError, one_line
from runtime.records import F32, F64
from runtime.support import progress, untrusted_input
from runtime.support.untrusted_input import LIMITS

POINTS, LINES, LOOP, LINE_STRIP, TRIANGLES, STRIP, FAN = range(7)  # primitive modes
WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
PLACES = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}  # instance attributes
OWN_PROBLEMS = ("an accessor", "bufferViews[", "a primitive", "a data URI")  # first words of this reader's own messages
DRACO = "KHR_draco_mesh_compression"
INSTANCES = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"
GLOSSY = "KHR_materials_pbrSpecularGlossiness"
DRAWN = {
    DRACO, GLOSSY, "KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_texture_transform",
    "KHR_mesh_quantization", "EXT_texture_webp", "EXT_texture_avif", INSTANCES, VISIBILITY,
    *gltf_splats.NAMES,
}  # fmt: skip
UNSEEN = {"KHR_materials_ior", "KHR_materials_specular", "KHR_materials_variants", "KHR_xmp_json_ld"}
# Extensions that are ignored, even if a file requires them.
WITHOUT = UNSEEN | {
    "KHR_lights_punctual", "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_transmission",
    "KHR_materials_volume", "KHR_materials_anisotropy", "KHR_materials_iridescence", "KHR_materials_dispersion",
    "KHR_materials_diffuse_transmission", "KHR_animation_pointer",
}  # fmt: skip


class GltfScene:
    """Loads a glTF file's scene as parts, points and splats, and records any features that are not drawn."""

    def __init__(self, path: Path, data: bytes, read: Read, origin: Origin) -> None:
        """Load a scene from glTF or GLB data; `read` reads other files, and parts and points are relative to `origin`.
        Raises InputError if it is not glTF 2.0, is damaged, exceeds a limit, or requires an unsupported extension.
        """
        self.path, self._origin = path, origin
        self._hidden: set[int] = set()  # numbers of the invisible nodes
        self.parts: list[Part] = []
        self.points: list[tuple[F32, F32]] = []  # positions (n, 3) and sRGB colours (n, 3), 0-1
        self.splats: list[Gaussians] = []
        self.left_out: set[str] = set()  # features that are not drawn
        try:
            self.file = GltfFile(path, data, read)
            self._check()
            self._read()
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise InputError(path, "", f"is damaged or is not glTF: {_problem(error)}") from None

    def _check(self) -> None:
        file, path = self.file, self.path
        for name in file.table.get("extensionsRequired", []):
            if name in COMPRESSED and name != DRACO:
                raise InputError(path, "extensionsRequired", f"{name}: {COMPRESSED[name]} is not supported; {WAY_OUT}")
            if name not in DRAWN | WITHOUT:
                raise InputError(path, "extensionsRequired", f"{untrusted_input.shown(name)} is not supported")
        meshes = [node["mesh"] for node in file.all("nodes") if "mesh" in node for _ in range(self._instances(node))]
        untrusted_input.within(len(meshes), LIMITS.instances, source=path, field="nodes")
        triangles = [sum(map(self._triangles, mesh["primitives"])) for mesh in file.all("meshes")]
        untrusted_input.within(sum(triangles[index] for index in meshes), LIMITS.triangles, source=path, field="meshes")
        file.check_pictures([file.item("textures", use["index"]) for use in self._textures()])

    def _triangles(self, primitive: Table) -> int:
        index = primitive.get("indices", primitive["attributes"].get("POSITION"))
        corners = 0 if index is None else self.file.count(index)
        return corners // 3 if primitive.get("mode", TRIANGLES) <= TRIANGLES else corners

    def _instances(self, node: Table) -> int:
        """Return the number of instances declared for a node by EXT_mesh_gpu_instancing, or 1."""
        own = node.get("extensions", {}).get(INSTANCES, {}).get("attributes", {})
        return min((self.file.count(index) for name, index in own.items() if name in PLACES), default=1)

    def _instanced(self, node: Table, matrix: F64) -> list[F64]:
        """Return the 4x4 scene_from_mesh matrix for each instance of a node's mesh."""
        own = node.get("extensions", {}).get(INSTANCES, {}).get("attributes", {})
        read = {PLACES[name]: self.file.accessor(index) for name, index in own.items() if name in PLACES}
        return [matrix @ _local({name: rows[k] for name, rows in read.items()}) for k in range(self._instances(node))]

    def _textures(self) -> Iterator[Table]:
        """Yield all materials' texture references, except those for properties that are not drawn."""
        for material in self.file.all("materials"):
            glossy = material.get("extensions", {}).get(GLOSSY, {})
            base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
            own = material.get("emissiveTexture") if any(material.get("emissiveFactor", ())) else None
            yield from filter(None, (glossy.get("diffuseTexture", base), own))

    def _read(self) -> None:
        world, file = self._world(), self.file
        meshes = [(node, matrix) for n, (node, matrix) in world.items() if "mesh" in node and n not in self._hidden]
        for number, (node, matrix) in enumerate(meshes):
            progress.tell(f"{self.path.name}: parts", number, len(meshes))
            mesh: Table = file.item("meshes", node["mesh"])
            stands = [self._joints(node, world)] if "skin" in node else self._instanced(node, matrix)
            weights: list[float] = node["weights"] if "weights" in node else mesh.get("weights", [])
            # A scale of zero hides an object (section 5.25).
            stands = [matrices for matrices in stands if matrices[..., :3, :3].any()]
            for primitive, matrices in itertools.product(mesh["primitives"], stands):
                self._add(primitive, weights=weights, matrices=matrices)
        self.left_out |= {"animations"} if file.all("animations") else set()
        self.left_out |= {str(name) for name in file.table.get("extensionsUsed", [])} - DRAWN - UNSEEN - {*COMPRESSED}

    def _world(self) -> dict[int, tuple[Table, F64]]:
        """Return the scene's nodes by number, each with its 4x4 scene_from_node matrix. Invisible nodes are included,
        because they may be joints, and recorded in `_hidden`. Raises InputError if nodes are nested too deeply.
        """
        nodes, scenes = self.file.all("nodes"), self.file.all("scenes")
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in children]
        if scenes:
            roots = self.file.item("scenes", self.file.table.get("scene", 0)).get("nodes", [])
        placed_nodes: dict[int, tuple[Table, F64]] = {}
        queue = [(root, np.eye(4), 1, True) for root in reversed(roots)]
        while queue:
            number, parent, depth, is_visible = queue.pop()
            if depth > LIMITS.depth:
                raise InputError(self.path, "nodes", f"are nested deeper than {LIMITS.depth}")
            if number not in placed_nodes:
                node = self.file.item("nodes", number)
                placed_nodes[number] = node, parent @ _local(node)
                is_visible &= node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True) is True
                self._hidden |= set() if is_visible else {number}
                children_of = reversed(node.get("children", []))
                queue += [(child, placed_nodes[number][1], depth + 1, is_visible) for child in children_of]
        return placed_nodes

    def _joints(self, node: Table, world: dict[int, tuple[Table, F64]]) -> F64:
        """Return the scene_from_mesh matrices (j, 4, 4) for the joints of a node's skin (section 3.7.3)."""
        skin = self.file.item("skins", node["skin"])
        stand = np.array([world[joint][1] if joint in world else np.eye(4) for joint in skin["joints"]])
        if "inverseBindMatrices" not in skin:
            return stand
        columns: F64 = self.file.accessor(skin["inverseBindMatrices"]).astype(np.float64)
        return np.asarray(stand @ columns[: len(stand)].transpose(0, 2, 1))

    def _add(self, primitive: Table, *, weights: list[float], matrices: F64) -> None:
        """Add a primitive's triangles, lines or points, with weights of its morph targets. `matrices`: scene_from_mesh
        (4, 4) or, for a skinned mesh, one per joint (j, 4, 4).
        """
        file, mode = self.file, primitive.get("mode", TRIANGLES)
        if gltf_splats.is_splats(primitive):
            splats = gltf_splats.read_splats(file, primitive)
            self.splats.append(
                gltf_splats.turned(splats, matrices[0] if matrices.ndim == 3 else matrices, self._origin)
            )
            untrusted_input.within(
                sum(len(one.centres) for one in self.splats), LIMITS.splats, source=self.path, field="splats"
            )
            return
        if "POSITION" not in primitive["attributes"]:
            return
        values, corners = self._draco(primitive)
        if corners is None:
            count = file.count(primitive["attributes"]["POSITION"])
            has_index = "indices" in primitive
            corners = file.accessor(primitive["indices"], as_float=False)[:, 0] if has_index else np.arange(count)
        faces = _faces(corners, mode)
        has_normals = "NORMAL" in primitive["attributes"] and mode >= TRIANGLES
        if has_normals or mode < TRIANGLES:
            rows, faces = np.unique(faces, return_inverse=True)  # drop vertices used only by other primitives
        else:  # flat shading requires that triangles share no vertices (section 3.7.2.1)
            rows, faces = faces.reshape(-1), np.arange(faces.size).reshape(-1, 3)

        def attribute(name: str) -> F32 | None:
            if name in values:
                return np.asarray(values[name][rows], np.float32)
            if name not in primitive["attributes"]:
                return None
            elements = file.accessor(primitive["attributes"][name], rows=rows)
            for target, weight in zip(primitive.get("targets", []), weights):
                if name in target and weight:
                    elements = np.asarray(elements + weight * file.accessor(target[name], rows=rows), np.float32)
            return elements

        positions, normals, colours = attribute("POSITION"), attribute("NORMAL"), attribute("COLOR_0")
        assert positions is not None
        if matrices.ndim == 3:
            matrices = self._skinned(matrices, attribute)
        positions, turned = placed(positions, normals if has_normals else None, matrices, origin=self._origin)
        look, use = self._look(primitive.get("material"))
        if mode < TRIANGLES:
            colours = coded(look["colour"] * (np.ones_like(positions) if colours is None else colours[:, :3]))
            self.points.append((positions, colours) if mode == POINTS else dotted(positions[faces], colours[faces]))
            return
        if turned is None:
            turned = np.repeat(flat_normals(positions[faces]), 3, axis=0)
        if matrices.ndim == 2 and np.linalg.det(matrices[:3, :3]) < 0:
            faces = faces[:, ::-1]
            turned = turned if has_normals else -turned
        uv = attribute(f"TEXCOORD_{_coordinates(use)[0]}")
        if uv is None:
            look |= {"picture": None, "glow_picture": None}
            uv = np.zeros((len(positions), 2), np.float32)
        shape = Shape(positions, turned, _transformed(uv, use), faces.astype(np.int32))
        is_plain = colours is None and look["glow"] == BLACK and (look["picture"] is None or look["colour"] == WHITE)
        if is_plain:
            look["colour"] = tuple(coded(look["colour"]).tolist())
        self.parts.append(Part(shape, vertex_colours=colours, is_linear=not is_plain, **look))

    def _skinned(self, joints: F64, attribute: Any) -> F64:
        """Return one matrix per vertex (v, 4, 4), each a weighted mean of the joints' matrices (j, 4, 4)."""
        names, weights = attribute("JOINTS_0"), attribute("WEIGHTS_0")
        for number in range(1, 4):
            if (more := attribute(f"JOINTS_{number}")) is not None:
                names = np.hstack([names, more])
                weights = np.hstack([weights, attribute(f"WEIGHTS_{number}")])
        share = weights / np.maximum(weights.sum(1, keepdims=True), 1e-9)
        total = np.zeros((len(names), 4, 4))
        for name, part in zip(names.T.astype(np.int64), share.T, strict=True):
            total += joints[name] * part[:, None, None]
        return total

    def _draco(self, primitive: Table) -> tuple[dict[str, Array], Array | None]:
        """Decode the attributes and vertex indices of a primitive compressed with Draco. Empty if the primitive is not
        compressed, or if DracoPy is not installed but the file also has the data uncompressed. Raises InputError if
        compressed data are needed but cannot be decoded.
        """
        own = primitive.get("extensions", {}).get(DRACO)
        if own is None:
            return {}, None
        try:
            import DracoPy
        except ImportError:
            accessors = [self.file.item("accessors", index) for index in primitive["attributes"].values()]
            if all("bufferView" in accessor for accessor in accessors):  # the file also contains the data uncompressed
                return {}, None
            problem = f"reading Draco requires `pip install 'phasestack[draco]'`; otherwise {WAY_OUT}"
            raise InputError(self.path, DRACO, problem) from None
        try:
            decoded = DracoPy.decode(bytes(self.file.view(own["bufferView"])[0]))
        except InputError as error:
            raise InputError(self.path, DRACO, error.problem) from None
        except DracoPy.FileTypeException:
            raise InputError(self.path, DRACO, "is damaged and cannot be decoded") from None
        arrays = {attribute["unique_id"]: attribute["data"] for attribute in decoded.attributes}
        values = {}
        for name, number in own["attributes"].items():
            accessor = self.file.item("accessors", primitive["attributes"][name])
            values[name] = fractions(arrays[number].reshape(len(arrays[number]), -1), accessor)
        return values, np.asarray(decoded.faces).reshape(-1)

    def _look(self, index: int | None) -> tuple[dict[str, Any], Table]:
        """Convert a material to `Part` fields, with linear colours, and return its texture reference."""
        file, material = self.file, {} if index is None else self.file.item("materials", index)
        own = material.get("extensions", {})
        base, prefix = material.get("pbrMetallicRoughness", {}), "baseColor"
        if GLOSSY in own:
            base, prefix = own[GLOSSY], "diffuse"
        *colour, opacity = base.get(f"{prefix}Factor", [1.0] * 4)
        strength = own.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        glow = tuple(float(value) * strength for value in material.get("emissiveFactor", BLACK))
        uses = base.get(f"{prefix}Texture"), material.get("emissiveTexture") if glow != BLACK else None
        use: Table = uses[0] or uses[1] or {}
        if uses[0] and uses[1] and _coordinates(uses[0]) != _coordinates(uses[1]):
            self.left_out.add("an emissive texture with its own coordinates")
            uses, glow = (uses[0], None), BLACK
        textures = [None if used is None else file.item("textures", used["index"]) for used in uses]
        pictures = [None if texture is None else file.picture(texture) for texture in textures]
        sampler: Table = {}
        for texture in filter(None, reversed(textures)):
            sampler = file.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = [WRAPS[sampler.get(name, 10497)] for name in ("wrapS", "wrapT")]
        return {
            "picture": pictures[0],
            "glow_picture": pictures[1],
            "glow": glow,
            "colour": tuple(map(float, colour)),
            "opacity": float(opacity),
            "alpha": {"MASK": "mask", "BLEND": "blend"}.get(material.get("alphaMode", ""), "opaque"),
            "cutoff": float(material.get("alphaCutoff", 0.5)),
            "two_sided": bool(material.get("doubleSided", False)),
            "lit": "KHR_materials_unlit" not in own,
            "sampler": Sampler((wrap[0], wrap[1]), sampler.get("magFilter") == NEAREST),
        }, use


def _problem(error: Exception) -> str:
    """Describe an error raised while reading a file."""
    if isinstance(error, KeyError):
        return f"{untrusted_input.shown(str(error))} is missing"
    if isinstance(error, IndexError):
        return "a reference points to a missing object"
    own = isinstance(error, ValueError) and error.args and str(error.args[0]).startswith(OWN_PROBLEMS)
    return one_line(str(error), most=120) if own else "a value has the wrong type"


def _local(node: Table) -> F64:
    """Return a node's 4x4 parent_from_node matrix."""
    if "matrix" in node:
        return np.asarray(np.array(node["matrix"], np.float64).reshape(4, 4).T)
    matrix = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    matrix[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _faces(corners: Array, mode: int) -> Array:
    """Group indices into triangles (t, 3), lines (n, 2) or points (n,) (3.7.2.1), or raise ValueError."""
    corners = np.asarray(corners).astype(np.int64)
    if mode == POINTS:
        return corners
    if mode == LINES:
        return corners[: len(corners) // 2 * 2].reshape(-1, 2)
    if mode in (LOOP, LINE_STRIP):
        return np.column_stack([corners, np.roll(corners, -1)])[: None if mode == LOOP else -1]
    if mode == TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    number = np.arange(max(len(corners) - 2, 0))
    if mode == STRIP:
        return corners[np.column_stack([number, number + 1 + number % 2, number + 2 - number % 2])]
    if mode == FAN:
        return corners[np.column_stack([number + 1, number + 2, np.zeros_like(number)])]
    raise ValueError(f"a primitive has the unsupported mode {mode}")


def _coordinates(use: Table) -> tuple[int, Table]:
    own: Table = use.get("extensions", {}).get("KHR_texture_transform", {})
    number: int = own["texCoord"] if "texCoord" in own else use.get("texCoord", 0)
    return number, own


def _transformed(uv: F32, use: Table) -> F32:
    """Scale, rotate and then shift texture coordinates (v, 2) according to KHR_texture_transform."""
    own = _coordinates(use)[1]
    if not own:
        return uv
    angle = float(own.get("rotation", 0.0))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    moved = (uv * np.array(own.get("scale", (1.0, 1.0)))) @ turn.T + np.array(own.get("offset", (0.0, 0.0)))
    return np.asarray(moved, np.float32)
