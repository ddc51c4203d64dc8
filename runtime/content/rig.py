"""What moves a loaded model: nodes in a tree, keys over time, bones and morph targets. Pure functions of a time.

The equations are glTF 2.0's (appendix C for the interpolations, 3.7.3 for skins).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from runtime.records import F32, F64

Path = Literal["translation", "rotation", "scale", "weights"]
Interpolation = Literal["LINEAR", "STEP", "CUBICSPLINE"]
TRIED = 24  # times of an animation at which its extent is looked at


@dataclass(frozen=True, slots=True)
class Node:
    """One node at rest."""

    moved: F64 = field(default_factory=lambda: np.zeros(3))
    turn: F64 = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))  # quaternion x, y, z, w
    scale: F64 = field(default_factory=lambda: np.ones(3))
    matrix: F64 | None = None  # (4, 4) in place of the three
    parent: int = -1


@dataclass(frozen=True, slots=True)
class Skin:
    """Bones."""

    joints: tuple[int, ...]  # nodes
    bone_from_mesh: F64  # (j, 4, 4) inverse bind matrices


@dataclass(frozen=True, slots=True)
class Binding:
    """What places one part, and moves its vertices."""

    node: int
    skin: Skin | None = None
    joints: NDArray[np.int32] | None = None  # (v, 4) indices into the skin's joints
    weights: F32 | None = None  # (v, 4) sum 1
    morphs: F32 | None = None  # (m, v, 3) offsets of positions
    rest_weights: F64 | None = None  # (m,)

    @property
    def deforms(self) -> bool:
        """Its vertices move against each other."""
        return self.skin is not None or self.morphs is not None


@dataclass(frozen=True, slots=True)
class Channel:
    """Keys of one node's translation, rotation, scale or morph weights."""

    node: int
    path: Path
    kind: Interpolation
    times_s: F64  # (k,) ascending
    values: F64  # (k, 1, w), or (k, 3, w): tangent before, value, tangent after

    def at(self, time_s: float) -> F64:
        """(w,) at a time; before the first key the first, after the last the last."""
        times = self.times_s
        after = int(np.searchsorted(times, time_s, side="right"))
        middle = self.values.shape[1] // 2
        if after == 0 or after == len(times):
            return self._unit(self.values[min(after, len(times) - 1), middle])
        before = after - 1
        span = times[after] - times[before]
        share = (time_s - times[before]) / span if span > 0 else 1.0
        first, second = self.values[before, middle], self.values[after, middle]
        if self.kind == "STEP":
            return np.asarray(first)
        if self.kind == "CUBICSPLINE":
            s2, s3 = share * share, share * share * share
            return self._unit(
                (2 * s3 - 3 * s2 + 1) * first
                + span * (s3 - 2 * s2 + share) * self.values[before, 2]
                + (3 * s2 - 2 * s3) * second
                + span * (s3 - s2) * self.values[after, 0]
            )
        if self.path == "rotation":
            return slerp(first, second, share)
        return np.asarray(first + (second - first) * share)

    def _unit(self, value: F64) -> F64:
        if self.path != "rotation":
            return value
        length = float(np.linalg.norm(value))
        return value / length if length > 0 else np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Pose:
    """A rig at one time."""

    scene_from_part: tuple[F64, ...]  # (4, 4) each; a skinned part's vertices are in the scene's frame: identity
    morph_weights: tuple[F64 | None, ...]  # (m,) each
    bones: tuple[F64 | None, ...]  # (j, 4, 4) scene_from_mesh of each bone of each part's skin


@dataclass(frozen=True, slots=True)
class Rig:
    """Nodes, what hangs on them, and how they move."""

    nodes: tuple[Node, ...]
    order: tuple[int, ...]  # of the scene's nodes: parents first
    bindings: tuple[Binding, ...]  # one a part
    channels: tuple[Channel, ...] = ()

    @property
    def moves(self) -> bool:
        """Something of it changes with time."""
        return self.duration_s > 0

    @property
    def duration_s(self) -> float:
        """Of the animation, which then begins again."""
        return max((float(channel.times_s[-1]) for channel in self.channels), default=0.0)

    def pose(self, time_s: float) -> Pose:
        """At a time from 0 to the duration."""
        values: dict[tuple[int, str], F64] = {
            (channel.node, channel.path): channel.at(time_s) for channel in self.channels
        }
        world: dict[int, F64] = {}
        for number in self.order:
            node = self.nodes[number]
            local = _local(node, values, number)
            world[number] = local if node.parent < 0 else world[node.parent] @ local
        identity = np.eye(4)
        placed, weights, bones = [], [], []
        for binding in self.bindings:
            placed.append(identity if binding.skin is not None else world[binding.node])
            given = values.get((binding.node, "weights"))
            count = 0 if binding.morphs is None else len(binding.morphs)
            weights.append(
                None if not count else given if given is not None and len(given) == count else binding.rest_weights
            )
            bones.append(None if binding.skin is None else _bones(binding.skin, world))
        return Pose(tuple(placed), tuple(weights), tuple(bones))

    def times_s(self) -> list[float]:
        """Times over which its extent is looked at."""
        return [self.duration_s * step / TRIED for step in range(TRIED + 1)] if self.moves else [0.0]


def deformed(positions: F32, normals: F32, binding: Binding, weights: F64 | None, bones: F64 | None) -> tuple[F32, F32]:
    """(v, 3) positions and unit normals of a part in a pose: morphed, then carried by its bones."""
    points = positions
    if binding.morphs is not None and weights is not None:
        points = points + np.tensordot(weights.astype(np.float32), binding.morphs, axes=1)
    if bones is None or binding.joints is None or binding.weights is None:
        return np.asarray(points, dtype=np.float32), normals
    rows = bones[:, :3].reshape(-1, 12).astype(np.float32)
    blended = np.einsum("vk,vkr->vr", binding.weights, rows[binding.joints], optimize=True).reshape(-1, 3, 4)
    moved = np.einsum("vij,vj->vi", blended[:, :, :3], points) + blended[:, :, 3]
    turned = np.einsum("vij,vj->vi", blended[:, :, :3], normals)
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return moved, np.divide(turned, length, out=np.zeros_like(turned), where=length > 0)


def slerp(first: F64, second: F64, share: float) -> F64:
    """(4,) unit quaternion on the shorter way between two."""
    first, second = first / (np.linalg.norm(first) or 1.0), second / (np.linalg.norm(second) or 1.0)
    cosine = float(first @ second)
    if cosine < 0:
        second, cosine = -second, -cosine
    if cosine > 0.9995:
        mixed = first + (second - first) * share
        return mixed / np.linalg.norm(mixed)
    angle = np.arccos(cosine)
    found: F64 = (np.sin((1 - share) * angle) * first + np.sin(share * angle) * second) / np.sin(angle)
    return found


def turn_of(quaternion: F64) -> F64:
    """3x3 rotation of a quaternion x, y, z, w; of one that is 0, none."""
    return np.asarray(Rotation.from_quat(quaternion).as_matrix()) if quaternion.any() else np.eye(3)


def _local(node: Node, values: dict[tuple[int, str], F64], number: int) -> F64:
    """(4, 4) parent_from_node."""
    if node.matrix is not None:
        return node.matrix
    matrix = np.eye(4)
    turn, scale = values.get((number, "rotation"), node.turn), values.get((number, "scale"), node.scale)
    matrix[:3, :3] = turn_of(turn) * scale
    matrix[:3, 3] = values.get((number, "translation"), node.moved)
    return matrix


def _bones(skin: Skin, world: dict[int, F64]) -> F64:
    identity = np.eye(4)  # of a bone that is not in the scene
    return np.stack([world.get(joint, identity) for joint in skin.joints]) @ skin.bone_from_mesh
