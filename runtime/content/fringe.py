"""Smooth outlines without multisampling, with a ramp one pixel wide outside each silhouette edge.

Four samples per pixel take a software rasteriser four times as long, while outlines have only a few hundred edges. The
ramps enlarge an object by half a pixel on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from runtime.content.shapes import I32, Shape
from runtime.records import F32, F64

CORNER_ENDS = (0, 0, 1, 1, 0, 1)


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of a triangle mesh, each with its one or two faces."""

    faces: I32  # (e, 2) faces; the second is -1 at a border
    ends: I32  # (e, 2, 2) both vertices of the edge in each face, in the same order
    apex: I32  # (e, 2) third vertex of each face
    normals: F64  # (t, 3) normals of the faces, not normalised
    heights: F64  # (t,) plane offsets: a face is visible to eyes whose product with its normal is larger
    border: NDArray[np.bool_]  # (e,) True for edges with one face


def edges_of(shape: Shape) -> Edges:
    """Return the edges of a shape. Vertices at the same position count as one."""
    positions = shape.positions_m.astype(np.float64)
    extent = max(float(np.ptp(positions, axis=0).max()), 1e-9)
    welded = np.unique(np.rint(positions / extent * 1e6).astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    triangles = shape.triangles
    vertices = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    apex = np.concatenate([triangles[:, 2], triangles[:, 0], triangles[:, 1]])
    face = np.tile(np.arange(len(triangles)), 3)
    swapped = welded[vertices[:, 0]] > welded[vertices[:, 1]]
    vertices[swapped] = vertices[swapped][:, ::-1]
    key = welded[vertices[:, 0]] * (int(welded.max()) + 1) + welded[vertices[:, 1]]
    places = np.sort(welded[triangles], axis=1)
    real = np.tile((np.diff(places, axis=1) > 0).all(1), 3)  # the poles of a sphere have triangles without area
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
    """Edges of several parts, from which the outlines that an eye sees are selected together."""

    def __init__(self, each: Sequence[Edges], *, vertices: Sequence[int]) -> None:
        """Collect the edges of all parts. each: edges of every part; vertices: its number of vertices.

        In results, vertices are numbered consecutively over all parts.
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

    def seen(self, eyes: Sequence[F64 | None]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return vertices (k, 3) of the edges on the outlines, and the parts (k,) to which they belong.

        An edge's vertices are its ends and the apex of its visible face. eyes: for each part, the eye (3,) in the
        part's frame; None excludes the part. Normals must point outwards.
        """
        edges = self._edges
        facing = np.zeros(len(edges.normals), bool)
        for (begin, end), eye in zip(self._faces, eyes, strict=True):
            if eye is not None:
                facing[begin:end] = edges.normals[begin:end] @ eye > edges.heights[begin:end]
        first, second = facing[edges.faces.T]
        is_seen = np.array([eye is not None for eye in eyes])[self._part]
        chosen = np.flatnonzero((edges.border | (first != second)) & is_seen)
        which = np.where(edges.border[chosen] | first[chosen], 0, 1)
        return np.column_stack([edges.ends[chosen, which], edges.apex[chosen, which]]), self._part[chosen]


def ramps(points: F64, *, width_px: int, height_px: int, ramp_px: float = 1.0) -> tuple[F32, NDArray[np.intp]]:
    """Return two triangles along each outline edge, with coverage 1 at the edge and 0 `ramp_px` outside.

    points: (k, 3, 4) clip coordinates of the edges' ends and apexes. Returns (m, 6, 5) clip coordinates and
    coverage of the corners, and the indices (m,) of the edges. Edges that are partly behind the eye or too short to
    have a direction are left out. Each corner gets the colour of the end that `CORNER_ENDS` names.
    """
    scale = np.array([width_px / 2, height_px / 2])
    kept = np.flatnonzero((points[..., 3] > 1e-6).all(1))
    points = points[kept]
    pixels = points[..., :2] / points[..., 3:] * scale
    along = pixels[:, 1] - pixels[:, 0]
    length = np.hypot(along[:, 0], along[:, 1])
    long_enough = length > 1e-3
    points, pixels, kept = points[long_enough], pixels[long_enough], kept[long_enough]
    along = along[long_enough] / length[long_enough, None]
    outward = np.column_stack([-along[:, 1], along[:, 0]])
    inside = ((pixels[:, 2] - pixels[:, 0]) * outward).sum(1)
    outward *= np.where(inside > 0, -ramp_px, ramp_px)[:, None]
    corners = np.repeat(points[:, :2], 2, axis=1)
    coverage = np.tile([1.0, 0.0, 1.0, 0.0], (len(points), 1))
    corners[:, 1::2, :2] += (outward / scale)[:, None] * corners[:, 1::2, 3:]
    quad = [0, 1, 2, 2, 1, 3]
    packed = np.concatenate([corners, coverage[..., None]], axis=2)[:, quad]
    return packed.astype(np.float32), kept
