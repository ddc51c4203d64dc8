"""Smooth outlines without multisampling, by drawing a coverage ramp outside each silhouette edge.

On a software rasteriser, drawing four samples per pixel takes four times as long, whereas outlines have only a few
hundred edges. Each ramp is one pixel wide, so objects are enlarged by half a pixel on average.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from runtime.content.shapes import I32, Shape, welded
from runtime.kernels import library
from runtime.records import F32, F64

if TYPE_CHECKING:
    from runtime.kernels.compiled import OutlinedPart

CORNER_FLOATS = 5 + 9  # clip coordinates and coverage (5), attributes (9)
TRIANGLES = (0, 2, 1, 1, 2, 3)


@dataclass(frozen=True, slots=True)
class Edges:
    """The edges of a triangle mesh, with the one or two faces that meet at each."""

    faces: I32  # (e, 2) indices of the faces at each edge; the second is -1 at a border
    ends: I32  # (e, 2, 2) each face's vertices at the edge's ends, in the same order for both faces
    apex: I32  # (e, 2) third vertex of each face
    normals: F64  # (t, 3) unnormalised normals of all faces
    heights: F64  # (t,) plane offsets; a face is visible from an eye if eye · normal > height

    @property
    def border(self) -> NDArray[np.bool_]:
        """True for edges with a single face, shape (e,)."""
        return self.faces[:, 1] < 0


def edges_of(shape: Shape) -> Edges:
    """Return the edges of a shape. Vertices at the same position are treated as one."""
    positions = shape.positions_m.astype(np.float64)
    triangles, places = shape.triangles, welded(shape.positions_m)
    vertices = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    apex = np.concatenate([triangles[:, 2], triangles[:, 0], triangles[:, 1]])
    face = np.tile(np.arange(len(triangles)), 3)
    swapped = places[vertices[:, 0]] > places[vertices[:, 1]]
    vertices[swapped] = vertices[swapped][:, ::-1]
    key = places[vertices[:, 0]] * (int(places.max()) + 1) + places[vertices[:, 1]]
    real = np.tile(
        (np.diff(np.sort(places[triangles], axis=1), axis=1) > 0).all(1), 3
    )  # a sphere has zero-area triangles at its poles
    order = np.flatnonzero(real)[np.argsort(key[real], kind="stable")]
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0]) if order.size else np.empty(0, np.int64)
    second = np.minimum(first + 1, max(order.size - 1, 0))
    paired = (second > first) & (key[order[second]] == key[order[first]])
    one, two = order[first], order[second]
    corner = positions[triangles]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return Edges(
        faces=np.column_stack([face[one], np.where(paired, face[two], -1)]).astype(np.int32),
        ends=np.stack([vertices[one], np.where(paired[:, None], vertices[two], vertices[one])], axis=1).astype(
            np.int32
        ),
        apex=np.column_stack([apex[one], np.where(paired, apex[two], apex[one])]).astype(np.int32),
        normals=normals,
        heights=np.einsum("ij,ij->i", normals, corner.mean(1)),
    )


class OutlineRamps:
    """Builds ramps along outlines: quadrilaterals whose coverage falls to 0 outside the outline."""

    def __init__(self, parts: Mapping[int, tuple[Edges, F32]]) -> None:
        """Prepare ramps for parts, by number: edges, and vertices (v, 12) of positions and attributes."""
        self._parts = {number: _outlined(*part) for number, part in parts.items()}
        self._ramps = np.empty((sum(len(edges.faces) for edges, _ in parts.values()), 4, CORNER_FLOATS), np.float32)

    def along(
        self, seen: Sequence[tuple[int, F64, F64]], *, width_px: int, height_px: int, ramp_px: float = 1.0
    ) -> tuple[F32, list[int]]:
        """Return ramps (m, 4, CORNER_FLOATS) along the outlines of parts, valid until the next call, and each
        part's number.

        `seen` lists the parts in the order of drawing: number, the eye (3,) in the part's frame, and its 4x4 clip
        matrix. Normals must point outwards. A ramp has two corners on its edge and then two outside the outline: clip
        coordinates (4), coverage, and the attributes (9) of the edge's nearest vertex, for the two triangles of
        `TRIANGLES`. An edge gets no ramp if it is partly behind the eye or too short to have a direction.
        """
        counts: list[int] = []
        for number, eye, clip_from_part in seen:
            eye, clip_from_part = (np.ascontiguousarray(array, np.float64) for array in (eye, clip_from_part))
            at = (width_px, height_px), ramp_px, self._ramps, sum(counts)
            counts.append(self._parts[number].ramps(eye, clip_from_part, *at))
        return self._ramps[: sum(counts)], counts


def _outlined(edges: Edges, vertices: F32) -> OutlinedPart:
    part: OutlinedPart = library().OutlinedPart(
        vertices, edges.faces, edges.ends, edges.apex, edges.normals, edges.heights
    )
    return part
