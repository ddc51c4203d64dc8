"""What moves a loaded model: nodes in a tree, keys over time, and bones. Pure functions of a time.

The equations are glTF 2.0's (appendix C for the interpolations, 3.7.3 for skins).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from runtime.content.shapes import Shape
from runtime.records import F32, F64

Path = Literal["translation", "rotation", "scale"]
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


@dataclass(frozen=True, slots=True)
class Channel:
    """Keys of one node's translation, rotation or scale."""

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

    def posed(self, shapes: Sequence[Shape], time_s: float) -> list[tuple[Shape, F64]]:
        """Every part deformed, and 4x4 scene_from_part, at a time from 0 to the duration.

        A skinned part's vertices come to be in the scene's frame.
        """
        values: dict[tuple[int, str], F64] = {
            (channel.node, channel.path): channel.at(time_s) for channel in self.channels
        }
        world: dict[int, F64] = {}
        for number in self.order:
            node = self.nodes[number]
            local = _local(node, values, number)
            world[number] = local if node.parent < 0 else world[node.parent] @ local
        placed = []
        for shape, binding in zip(shapes, self.bindings, strict=True):
            if binding.skin is not None:
                shape = _bent(shape, binding, _bones(binding.skin, world))
            placed.append((shape, np.eye(4) if binding.skin is not None else world[binding.node]))
        return placed

    def times_s(self) -> list[float]:
        """Times over which its extent is looked at."""
        return [self.duration_s * step / TRIED for step in range(TRIED + 1)] if self.moves else [0.0]


def _bent(shape: Shape, binding: Binding, bones: F64) -> Shape:
    """Its vertices carried by bones (j, 4, 4)."""
    assert binding.joints is not None and binding.weights is not None
    rows = bones[:, :3].reshape(-1, 12).astype(np.float32)
    blended = np.einsum("vk,vkr->vr", binding.weights, rows[binding.joints], optimize=True).reshape(-1, 3, 4)
    moved = np.einsum("vij,vj->vi", blended[:, :, :3], shape.positions_m) + blended[:, :, 3]
    turned = np.einsum("vij,vj->vi", blended[:, :, :3], shape.normals)
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    normals = np.divide(turned, length, out=np.zeros_like(turned), where=length > 0)
    return replace(shape, positions_m=moved, normals=normals)


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
