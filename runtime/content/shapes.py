"""Triangle meshes (shapes) and functions that create them. Every shape's normals point outwards."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.records import F32, F64

I32 = NDArray[np.int32]

FAR = 64.0  # positions farther from zero than this many times their extent are centred before they become float32
AT_ONCE = 1 << 17  # number of vertices or faces processed together, to limit memory use

# Letters needed by the built-in scenes, in 5 x 7 cells with one string per row.
GLYPHS = {
    "3": ("####.", "....#", "....#", ".###.", "....#", "....#", "####."),
    "D": ("####.", "#...#", "#...#", "#...#", "#...#", "#...#", "####."),
    "P": ("####.", "#...#", "#...#", "####.", "#....", "#....", "#...."),
    "H": ("#...#", "#...#", "#...#", "#####", "#...#", "#...#", "#...#"),
    "A": (".###.", "#...#", "#...#", "#####", "#...#", "#...#", "#...#"),
    "S": (".####", "#....", "#....", ".###.", "....#", "....#", "####."),
    "E": ("#####", "#....", "#....", "####.", "#....", "#....", "#####"),
}


@dataclass(frozen=True, slots=True)
class Shape:
    """Triangle mesh with normals and texture coordinates."""

    positions_m: F32  # (v, 3) vertices
    normals: F32  # (v, 3) unit normal at each vertex
    uv: F32  # (v, 2) texture coordinates at each vertex
    triangles: I32  # (t, 3) indices of each triangle's vertices

    def moved(self, rotation: F64 | None = None, offset_m: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
        """Return a copy of the shape, rotated about the origin by a 3x3 matrix and then shifted."""
        turn = np.eye(3) if rotation is None else rotation
        positions = self.positions_m @ turn.T + np.asarray(offset_m)
        return Shape(positions.astype(np.float32), (self.normals @ turn.T).astype(np.float32), self.uv, self.triangles)


def join(shapes: Sequence[Shape]) -> Shape:
    """Join several shapes into one."""
    starts = np.cumsum([0, *(len(shape.positions_m) for shape in shapes)])
    return Shape(
        np.concatenate([shape.positions_m for shape in shapes]),
        np.concatenate([shape.normals for shape in shapes]),
        np.concatenate([shape.uv for shape in shapes]),
        np.concatenate([shape.triangles + start for shape, start in zip(shapes, starts, strict=False)]).astype(
            np.int32
        ),
    )


def welded(positions_m: F32) -> NDArray[np.int64]:
    """Number the distinct positions of vertices (v, 3), and return each vertex's number (v,)."""
    positions = positions_m.astype(np.float64)
    extent = max(float(np.ptp(positions, axis=0).max()), 1e-9)
    places = np.rint(positions / extent * 1e6).astype(np.int64)
    return np.asarray(np.unique(places, axis=0, return_inverse=True)[1].reshape(-1), np.int64)


def solid_winding(shape: Shape) -> int:
    """Return the winding of a solid shape's triangles, 1 (counter-clockwise from outside) or -1, or 0 if
    it is not solid. The triangles of a solid shape enclose volumes and have the same winding everywhere, so its back
    faces are always hidden. Vertices at the same position are treated as one, and connected triangles as one body.
    """
    corners = welded(shape.positions_m)[shape.triangles]
    real = (np.diff(np.sort(corners, axis=1), axis=1) > 0).all(1)  # a sphere has zero-area triangles at its poles
    corners, triangles = corners[real], shape.triangles[real]
    if not len(corners):
        return 0
    count = int(corners.max()) + 1
    begin, end = corners.reshape(-1), corners[:, [1, 2, 0]].reshape(-1)
    if not np.array_equal(np.sort(begin * count + end), np.sort(end * count + begin)):
        return 0  # an edge is not passed as often in one direction as in the other
    body = np.arange(count)
    while True:  # the smallest vertex number spreads over each body
        before = body
        body = before.copy()
        np.minimum.at(body, corners.reshape(-1), np.repeat(before[corners].min(1), 3))
        body = body[body]
        if np.array_equal(body, before):
            break
    points = (shape.positions_m - shape.positions_m.mean(0)).astype(np.float64)[triangles]
    volumes = (points[:, 0] * np.cross(points[:, 1], points[:, 2])).sum(1)
    of_body = np.bincount(body[corners[:, 0]], volumes, count)[np.unique(body[corners])]
    return int((of_body > 0).all()) - int((of_body < 0).all())


def flat_normals(corners: ArrayLike) -> F32:
    """Return the unit normals (t, 3) of triangles' corners (t, 3, 3), zero for a triangle without area."""
    corners = np.asarray(corners)
    normals = np.empty((len(corners), 3), np.float32)
    for first in range(0, len(corners), AT_ONCE):
        corner = corners[first : first + AT_ONCE].astype(np.float64)
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normals[first : first + AT_ONCE] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return normals


class Origin:
    """Point subtracted from a file's coordinates before they become float32: usually zero."""

    def __init__(self) -> None:
        self.point: F64 | None = None  # (3,) in the file's coordinates; None before the first positions

    def relative(self, positions: ArrayLike) -> F64:
        """Return positions (..., 3) relative to the origin, which the first call chooses."""
        places = np.asarray(positions, np.float64)
        if self.point is None and places.size:
            low, high = (end(places.reshape(-1, 3), 0) for end in (np.min, np.max))
            is_far = np.abs(low + high).max() > 2 * FAR * (high - low).max()
            self.point = (low + high) / 2 if is_far else np.zeros(3)
        return places if self.point is None or not self.point.any() else places - self.point


def placed(positions: ArrayLike, normals: ArrayLike | None, matrices: F64, *, origin: Origin) -> tuple[F32, F32 | None]:
    """Transform positions and normals (v, 3) or None by one affine matrix (4, 4), or one per vertex (v,
    4, 4), and subtract `origin`. Normals remain unit vectors.
    """
    positions = np.asarray(positions)
    moved = np.empty(positions.shape, np.float32)
    turned = None if normals is None else np.empty(positions.shape, np.float32)
    for first in range(0, len(positions), AT_ONCE):  # chunks limit the memory that double precision needs
        rows = slice(first, first + AT_ONCE)
        matrix = matrices[rows] if matrices.ndim == 3 else matrices
        linear = matrix[..., :3, :3]
        moved[rows] = origin.relative(_times(linear, positions[rows]) + matrix[..., :3, 3])
        if normals is not None and turned is not None:
            # Joints are assumed to scale uniformly, whereas nodes may have any linear transformation.
            turn = linear if matrices.ndim == 3 else np.linalg.pinv(linear).T
            normal = _times(turn, np.asarray(normals)[rows])
            turned[rows] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return moved, turned


def _times(matrix: NDArray[Any], vectors: NDArray[Any]) -> NDArray[Any]:
    """Multiply vectors (v, 3) by one matrix (3, 3), or by one matrix per vector (v, 3, 3)."""
    return np.asarray(vectors @ matrix.T if matrix.ndim == 2 else np.einsum("nij,nj->ni", matrix, vectors))


def rotation_about(axis: int, angle_rad: float) -> F64:
    """Return the 3x3 matrix for a right-handed rotation about the x (0), y (1) or z (2) axis."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = cosine, -sine, sine, cosine
    return matrix


def _grid(u: F64, v: F64) -> tuple[F64, F64, I32]:
    """Return the u and v of each vertex of a grid with these columns and rows, and its triangles (t, 3)."""
    columns, rows = len(u), len(v)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    first = np.column_stack([corner, corner + 1, corner + columns])
    second = np.column_stack([corner + 1, corner + columns + 1, corner + columns])
    grid_u, grid_v = np.meshgrid(u, v)
    return grid_u.reshape(-1), grid_v.reshape(-1), np.concatenate([first, second]).astype(np.int32)


def _shape(positions: F64, normals: F64, uv: F64, triangles: I32) -> Shape:
    return Shape(positions.astype(np.float32), normals.astype(np.float32), uv.astype(np.float32), triangles)


def card(width_m: float, height_m: float, *, repeat: tuple[float, float] = (1.0, 1.0)) -> Shape:
    """Return a rectangle in x = 0, width along y, whose repeated texture is upright from +x."""
    s, t, triangles = _grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    positions = np.column_stack([0 * s, (s - 0.5) * width_m, (0.5 - t) * height_m])
    return _shape(
        positions, np.tile([1.0, 0.0, 0.0], (4, 1)), np.column_stack([s * repeat[0], t * repeat[1]]), triangles
    )


def box(size_m: Sequence[float]) -> Shape:
    """Return a box centred on the origin. Each face shows the whole texture."""
    sx, sy, sz = size_m
    turns = [
        (np.eye(3), (sy, sz), sx),
        (rotation_about(2, np.pi), (sy, sz), sx),
        (rotation_about(2, np.pi / 2), (sx, sz), sy),
        (rotation_about(2, -np.pi / 2), (sx, sz), sy),
        (rotation_about(1, -np.pi / 2), (sy, sx), sz),
        (rotation_about(1, np.pi / 2), (sy, sx), sz),
    ]
    return join([card(*face).moved(turn, turn @ [depth / 2, 0.0, 0.0]) for turn, face, depth in turns])


def sphere(radius_m: float, *, columns: int = 48, rows: int = 24) -> Shape:
    """Return a sphere centred on the origin, with its poles on the z axis."""
    s, t, triangles = _grid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    longitude, polar = s * 2 * np.pi, t * np.pi
    normal = np.column_stack([np.cos(longitude) * np.sin(polar), np.sin(longitude) * np.sin(polar), np.cos(polar)])
    return _shape(normal * radius_m, normal, np.column_stack([2 * s, t]), triangles)


def torus(radius_m: float, tube_m: float, *, columns: int = 64, rows: int = 24) -> Shape:
    """Return a torus around the x axis; `columns` are segments around the axis, `rows` around the tube."""
    s, t, triangles = _grid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    around, across = s * 2 * np.pi, t * 2 * np.pi
    normal = np.column_stack([np.sin(across), np.cos(around) * np.cos(across), np.sin(around) * np.cos(across)])
    centre = np.column_stack([0 * around, np.cos(around), np.sin(around)]) * radius_m
    return _shape(centre + normal * tube_m, normal, np.column_stack([6 * s, 2 * t]), triangles)


def _runs(marks: str) -> list[tuple[int, int]]:
    """Return each run of `#` as its start and length."""
    return [(match.start(), match.end() - match.start()) for match in re.finditer("#+", marks)]


def lettering(text: str, *, cell_m: float, depth_m: float) -> Shape:
    """Return text of `GLYPHS`, solid letters of 5 x 7 cells, one cell apart, readable from +x."""
    left = -(len(text) * 6 - 1) / 2
    bars = []
    for index, letter in enumerate(text):
        rows = GLYPHS[letter]
        columns = ["".join(row[column] for row in rows) for column in range(5)]
        across = [(row, start, 1, length) for row, line in enumerate(rows) for start, length in _runs(line)]
        down = [(start, column, length, 1) for column, line in enumerate(columns) for start, length in _runs(line)]
        for row, column, high, wide in (*across, *(bar for bar in down if bar[2] > 1)):
            centre = (0.0, (left + index * 6 + column + wide / 2) * cell_m, (3.5 - row - high / 2) * cell_m)
            bars.append(box((depth_m, wide * cell_m, high * cell_m)).moved(offset_m=centre))
    return join(bars)


def fence(width_m: float, height_m: float, *, bars: int, bar_m: float) -> Shape:
    """Return a fence with upright bars and two rails, all `bar_m` thick, in the plane x = 0."""
    upright = [
        box((bar_m, bar_m, height_m)).moved(offset_m=(0.0, y, 0.0))
        for y in np.linspace(-width_m / 2, width_m / 2, bars)
    ]
    rails = [box((bar_m, width_m, bar_m)).moved(offset_m=(0.0, 0.0, z)) for z in (-0.3 * height_m, 0.3 * height_m)]
    return join([*upright, *rails])
