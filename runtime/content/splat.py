"""Draw 3D Gaussian splats by sorting and blending them with OpenGL."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from runtime.content.base import ContentInfo, View
from runtime.content.canvas import OVER, SIDES, CanvasSource
from runtime.content.compressed_splats import load_compressed, load_compressed_splats, load_splat
from runtime.content.gaussians import (
    AT_ONCE,
    Gaussians,
    Splats,
    bounds,
    colours_towards,
    load_gaussians,
    moved,
    nearest_blocks,
    seen_splats,
)
from runtime.content.placing import SceneFile
from runtime.content.ply import read_header
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64
from runtime.support.gl import DrawnPicture

CUSTOM, CUSTOM_SPZ = ("-y", "-z"), ("+y", "+z")  # axes (up, to the viewer); trainers use OpenCV's camera axes
FLOATS = 8  # floats per corner: clip position (2), position in standard deviations (2), colour and opacity (4)
VERTEX = """
#version 330
in vec2 in_place;
in vec2 in_deviations;
in vec4 in_colour;
out vec2 deviations;
flat out vec4 colour;
void main() {
    deviations = in_deviations;
    colour = in_colour;
    gl_Position = vec4(in_place, 0.0, 1.0);
}
"""
FRAGMENT = """
#version 330
in vec2 deviations;
flat in vec4 colour;
out vec4 pixel;
void main() {
    float alpha = min(0.99, colour.a * exp(-0.5 * dot(deviations, deviations)));
    if (alpha < 1.0 / 255.0) discard;
    pixel = vec4(colour.rgb, alpha);
}
"""


def prepare(file: SceneFile) -> Callable[..., SplatSource]:
    """Read a splat file, and return a function that creates the source in a GL context. Raises InputError
    if the file cannot be read or contains no visible splats.
    """
    suffix = file.path.suffix.lower()
    if suffix == ".ply":
        header = read_header(file.path)
        gaussians = load_compressed(header) if header.is_packed else load_gaussians(header)
    else:
        gaussians = load_splat(file.path) if suffix == ".splat" else load_compressed_splats(file.path)
    matrix = file.placed(*bounds(gaussians), custom=CUSTOM_SPZ if suffix == ".spz" else CUSTOM)
    info = ContentInfo(file.path.stem, background=file.background)
    return partial(SplatSource, gaussians, stack_from_scene=matrix, info=info)


class SplatSource(CanvasSource):
    """Source that draws a Gaussian splat scene."""

    def __init__(self, gaussians: Gaussians, *, stack_from_scene: F64, context: Any, info: ContentInfo) -> None:
        super().__init__(context, info=info, deep=True)
        self._gaussians = moved(gaussians, stack_from_scene)
        self._seen: list[Splats | None] = [None] * SIDES  # visible splats in each side's latest picture
        linear = stack_from_scene[:3, :3]
        self._scene_from_stack_rotation = (np.linalg.inv(linear) * np.cbrt(np.linalg.det(linear))).astype(np.float32)
        self._program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        count = min(len(gaussians.centres), AT_ONCE)
        self._corners = np.empty((count, 4, FLOATS), np.float32)
        self._buffer = context.buffer(reserve=max(self._corners.nbytes, 1), dynamic=True)
        quads = np.arange(count, dtype=np.int32)[:, None] * 4 + np.array([0, 1, 2, 2, 1, 3], np.int32)
        indices = context.buffer(np.ascontiguousarray(quads).tobytes())
        self._vertices = context.vertex_array(
            self._program, [(self._buffer, "2f 2f 4f", "in_place", "in_deviations", "in_colour")], index_buffer=indices
        )
        self.held += [self._program, self._buffer, indices, self._vertices]

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        """Draw the visible splats, farthest first."""
        splats = self._seen[view.side] = seen_splats(self._gaussians, view)
        count = len(splats.index)

        def paint() -> None:
            self.context.enable_only(self.context.BLEND)
            self.context.blend_func = OVER
            for first in range(0, count, AT_ONCE):
                if first:
                    self._buffer.orphan()  # the GPU may still be reading the previous storage
                self._vertices.render(vertices=6 * self._prepare(view, splats, slice(first, first + AT_ONCE)))

        whole = PixelRect(0, 0, view.width_px, view.height_px if count else 0)
        return self.drawn(view, whole, paint)

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        splats = self._seen[view.side]
        return None if splats is None else nearest_blocks(splats, view, every=every, first=first)

    def _prepare(self, view: View, splats: Splats, some: slice) -> int:
        """Fill the vertex buffer with a slice of the visible splats, and return the number of splats written."""
        index, reach = splats.index[some], splats.reach[some]
        count = len(index)
        directions = self._gaussians.centres[index] - view.eye_m.astype(np.float32)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), np.float32(1e-9))
        directions = directions @ self._scene_from_stack_rotation.T
        corners = self._corners[:count]
        scale = np.array([2 / view.width_px, 2 / view.height_px], np.float32)
        for corner, (right, down) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
            offset = splats.major_px[some] * np.float32(right) + splats.minor_px[some] * np.float32(down)
            corners[:, corner, 0:2] = (splats.centres_px[some] + offset * reach[:, None]) * scale - 1
            corners[:, corner, 2] = reach * right
            corners[:, corner, 3] = reach * down
        corners[:, :, 4:7] = colours_towards(self._gaussians.harmonics[index], directions)[:, None]
        corners[:, :, 7] = splats.opacities[some, None]
        self._buffer.write(corners)
        return count
