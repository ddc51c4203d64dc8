"""Smooth outlines without multisampling, by drawing a coverage ramp outside each silhouette edge.

On a software rasteriser, drawing four samples per pixel takes four times as long, whereas outlines have only a few
hundred edges. Each ramp is one pixel wide, so objects are enlarged by half a pixel on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from runtime.content.shapes import I32, Shape, welded
from runtime.records import F32, F64

CORNER_ENDS = (0, 1, 0, 1)  # two corners on the edge, then two outside the outline
TRIANGLES = (0, 2, 1, 1, 2, 3)


@dataclass(frozen=True, slots=True)
class Edges:
    """The edges of a triangle mesh, with the one or two faces that meet at each."""

    faces: I32  # (e, 2) indices of the faces at each edge; the second is -1 at a border
    ends: I32  # (e, 2, 2) each face's vertices at the edge's ends, in the same order for both faces
    apex: I32  # (e, 2) third vertex of each face
    normals: F64  # (t, 3) unnormalised normals of all faces
    heights: F64  # (t,) plane offsets; a face is visible from an eye if eye · normal > height
    border: NDArray[np.bool_]  # (e,) True for edges with a single face


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
        border=~paired,
    )


class Outlines:
    """The edges of several parts. `seen` selects the ones that are on an outline as seen by an eye."""

    def __init__(self, each: Sequence[Edges], *, vertices: Sequence[int]) -> None:
        """Combine the edges of all parts. Vertices are numbered consecutively across the parts.

        Args:
            each: Edges of each part.
            vertices: Number of vertices in each part.
        """
        faces_before = np.cumsum([0, *(len(edges.normals) for edges in each)])
        self.vertices_before = np.cumsum([0, *vertices])
        self._faces = list(pairwise(faces_before.tolist()))
        self._edges = Edges(
            faces=np.concatenate([edges.faces + n for edges, n in zip(each, faces_before, strict=False)]),
            ends=np.concatenate([edges.ends + n for edges, n in zip(each, self.vertices_before, strict=False)]),
            apex=np.concatenate([edges.apex + n for edges, n in zip(each, self.vertices_before, strict=False)]),
            normals=np.concatenate([edges.normals for edges in each]),
            heights=np.concatenate([edges.heights for edges in each]),
            border=np.concatenate([edges.border for edges in each]),
        )
        self._part = np.repeat(np.arange(len(each)), [len(edges.faces) for edges in each])
        self._first, self._second = np.ascontiguousarray(self._edges.faces.T, np.intp)

    def seen(self, eyes: Sequence[F64 | None]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the edges that are on an outline, and the index of each edge's part.

        Each edge is described by three vertices: its ends and the third vertex of its visible face. All parts' normals
        must point outwards.

        Args:
            eyes: For each part, the eye's position (3,) in the part's frame, or None to exclude the part.

        Returns:
            The vertices (k, 3) and part indices (k,) of k edges.
        """
        edges = self._edges
        facing = np.zeros(len(edges.normals), bool)
        for (begin, end), eye in zip(self._faces, eyes, strict=True):
            if eye is not None:
                facing[begin:end] = edges.normals[begin:end] @ eye > edges.heights[begin:end]
        first = facing[self._first]
        chosen = np.flatnonzero(edges.border | (first != facing[self._second]))
        if any(eye is None for eye in eyes):
            chosen = chosen[np.array([eye is not None for eye in eyes])[self._part[chosen]]]
        which = np.where(edges.border[chosen] | first[chosen], 0, 1)
        return np.column_stack([edges.ends[chosen, which], edges.apex[chosen, which]]), self._part[chosen]


def ramps(points: F64, *, width_px: int, height_px: int, ramp_px: float = 1.0) -> tuple[F32, NDArray[np.intp]]:
    """Return a ramp, a quadrilateral, for each outline edge.

    A ramp's coverage falls from 1 at the edge to 0 outside the outline. An edge gets no ramp if it is partly behind the
    eye or too short to have a direction.

    Args:
        points: Clip coordinates (k, 3, 4) of each edge's two ends and of the third vertex of its visible face.
        width_px: Raster width.
        height_px: Raster height.
        ramp_px: Ramp width in pixels.

    Returns:
        Clip coordinates and coverage (m, 4, 5) at the four corners of each of m ramps, and the index (m,) of each
        ramp's edge. `CORNER_ENDS` states which end of the edge each corner takes its attributes from, and `TRIANGLES`
        which corners form the two triangles.
    """
    kept = np.flatnonzero((points[..., 3] > 1e-6).all(1))
    points = points[kept]
    w = points[..., 3]
    u, v = points[..., 0] / w * (width_px / 2), points[..., 1] / w * (height_px / 2)
    along_u, along_v = u[:, 1] - u[:, 0], v[:, 1] - v[:, 0]
    length = np.hypot(along_u, along_v)
    long_enough = length > 1e-3
    kept, points = kept[long_enough], points[long_enough]
    length, along_u, along_v = length[long_enough], along_u[long_enough], along_v[long_enough]
    inside = (v[long_enough, 2] - v[long_enough, 0]) * along_u - (u[long_enough, 2] - u[long_enough, 0]) * along_v
    outward = np.where(inside > 0, -ramp_px, ramp_px) / length
    corners = np.empty((len(kept), 4, 5), np.float32)
    corners[:, :2, :4] = corners[:, 2:, :4] = points[:, :2]
    corners[:, 2:, 0] -= (along_v * outward / (width_px / 2))[:, None] * points[:, :2, 3]
    corners[:, 2:, 1] += (along_u * outward / (height_px / 2))[:, None] * points[:, :2, 3]
    corners[:, :2, 4], corners[:, 2:, 4] = 1.0, 0.0
    return corners, kept
