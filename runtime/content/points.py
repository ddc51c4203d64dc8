"""Point clouds: coloured discs that face the eye, as large as the points lie apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from scipy.spatial import cKDTree

from runtime.content import camera
from runtime.content.base import ContentInfo, View
from runtime.content.canvas import CanvasSource
from runtime.content.placing import SceneFile
from runtime.content.ply import Header, Table, read_header, read_vertices
from runtime.errors import InputError
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64
from runtime.support.gl import DrawnPicture, linked_program

COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
GREY = (0.45, 0.45, 0.45)  # of points without a colour
MEASURED = 2000  # points whose neighbours are looked for
NEIGHBOURS = 8  # the farthest of so many says how dense points lie, on a grid as at random
DISC_PER_GAP = 1.25  # so that the surface closes
LARGEST_COORDINATE = 1e15
LARGEST_PX = 64.0
STRAY = 0.5  # percent of the points at either end of an axis that do not decide the scale
VERTEX = """
#version 330
uniform mat4 clip_from_stack;
uniform float pixels;  // of a disc, at a metre from the eye
in vec3 in_position;
in vec3 in_colour;
out vec3 colour;
void main() {
    colour = in_colour;
    gl_Position = clip_from_stack * vec4(in_position, 1.0);
    gl_PointSize = clamp(pixels / gl_Position.w, 2.0, LARGEST);
}
""".replace("LARGEST", str(LARGEST_PX))
FRAGMENT = """
#version 330
in vec3 colour;
out vec4 pixel;
void main() {
    vec2 place = 2.0 * gl_PointCoord - 1.0;
    if (dot(place, place) > 1.0) discard;
    pixel = vec4(colour, 1.0);
}
"""


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points in a file's own frame."""

    positions: F32  # (n, 3)
    colours: F32  # (n, 3), 0-1
    gap: float  # median distance to the farthest of the nearest neighbours


def prepare(file: SceneFile) -> Callable[[Any], PointSource]:
    """Read it; the answer uploads it. Raises InputError."""
    cloud = load_points(read_header(file.path))
    low, high = np.percentile(cloud.positions.astype(np.float64), [STRAY, 100 - STRAY], axis=0)
    matrix = file.placed(low, high)
    info = ContentInfo(file.path.stem, background=file.background)
    return lambda context: PointSource(cloud, stack_from_scene=matrix, context=context, info=info)


def load_points(header: Header) -> Cloud:
    """The points of a PLY. Raises InputError: unreadable, none, not finite."""
    table, path = read_vertices(header), header.path
    names = table.dtype.names or ()
    for axis in "xyz":
        if axis not in names:
            raise InputError(path, axis, "the property is missing: these are no points")
    if not len(table):
        raise InputError(path, "vertex", "there are none")
    with np.errstate(over="ignore"):
        positions = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float32)
    broken = int((~(np.abs(positions) <= LARGEST_COORDINATE).all(1)).sum())  # NaN too
    if broken:
        raise InputError(path, "x, y, z", f"{broken} of {len(positions)} are not finite, or beyond any scene")
    return Cloud(positions, _colours(table, names), _gap(positions))


def _colours(table: Table, names: tuple[str, ...]) -> F32:
    for three in COLOURS:
        if all(name in names for name in three):
            columns = np.column_stack([table[name] for name in three])
            scale = np.iinfo(columns.dtype).max if columns.dtype.kind in "ui" else 1.0
            found: F32 = np.clip(np.nan_to_num(columns.astype(np.float32)) / np.float32(scale), 0.0, 1.0)
            return found
    return np.tile(np.array(GREY, np.float32), (len(table), 1))


def _gap(positions: F32) -> float:
    if len(positions) < 2:
        return 0.0
    chosen = np.random.default_rng(0).choice(len(positions), min(MEASURED, len(positions)), replace=False)
    count = min(NEIGHBOURS + 1, len(positions))
    distances = cKDTree(positions).query(positions[chosen], k=count)[0][:, -1]
    return float(np.median(distances))


class PointSource(CanvasSource):
    """A cloud at its place in the stack frame."""

    def __init__(self, cloud: Cloud, *, stack_from_scene: F64, context: Any, info: ContentInfo) -> None:
        super().__init__(context, info=info)
        linear = stack_from_scene[:3, :3]
        positions = (cloud.positions @ linear.T + stack_from_scene[:3, 3]).astype(np.float32)
        extent_m = float(np.ptp(positions, axis=0).max())
        gap_m = cloud.gap * float(np.cbrt(abs(np.linalg.det(linear))))
        # Two points, or many at one place, have no gap that says how large they are.
        self._disc_m = DISC_PER_GAP * min(max(gap_m, extent_m / 1000), max(extent_m / 20, 1e-4)) or 1e-3
        self._program = linked_program(context, vertex=VERTEX, fragment=FRAGMENT)
        buffer = context.buffer(np.concatenate([positions, cloud.colours], axis=1, dtype=np.float32))
        self._vertices = context.vertex_array(
            self._program, [(buffer, "3f 3f", "in_position", "in_colour")], mode=moderngl.POINTS
        )
        margin = self._disc_m / 2
        low, high = positions.min(0).astype(np.float64) - margin, positions.max(0).astype(np.float64) + margin
        self._corners_m = camera.box_corners(low, high)
        self.held += [self._program, buffer, self._vertices]

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        def paint() -> None:
            clip = camera.clip_from_stack(view, self._corners_m)
            self.context.enable_only(self.context.DEPTH_TEST | self.context.PROGRAM_POINT_SIZE)
            self._program["clip_from_stack"].write(np.ascontiguousarray(clip.T, np.float32))
            self._program["pixels"] = self._disc_m * _pixels_per_radian(view)
            self._vertices.render()

        return self.drawn(view, self.extent(view, time_ns=time_ns), paint)

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        return camera.covered_box(view, self._corners_m, align_px=1)


def _pixels_per_radian(view: View) -> float:
    """Of a small length across the gaze, times its distance: at the view's middle."""
    u, _, w = view.pixels_from_stack[:, :3]
    return float(np.linalg.norm(u - view.width_px / 2 * w))
