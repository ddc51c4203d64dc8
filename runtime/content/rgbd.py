"""A picture with depth: colour and a grey depth map side by side, drawn as a surface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.content.base import ContentInfo, DrawingSource, View
from runtime.content.images import rgba_from_rgb
from runtime.content.pictures import screen
from runtime.content.shapes import Shape
from runtime.content.triangles import Part, TrianglePainter
from runtime.errors import InputError
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F32, U8
from runtime.support.gl import DrawnPicture

COLUMNS = 320  # of the surface: as fine as depth cameras see, and quick without a graphics card
NOMINAL_DISTANCE_M = 0.6  # from here the surface looks like the picture
TORN_RELATIVE = 0.12  # of the depth range: a larger step between neighbours is an edge, not a slope


def split_rgbd(rgb: U8, path: Path) -> tuple[U8, F32]:
    """(h, w, 3) colour and (h, w) depth in [0, 1], 1 nearest: the left and right halves. Raises InputError."""
    width = rgb.shape[1] // 2
    if width < 2 or rgb.shape[0] < 2:
        raise InputError(path, "layout", "the picture is too small for colour and depth side by side")
    depth = rgb[:, width : 2 * width]
    if np.ptp(depth[::4, ::4].astype(np.int16), axis=2).max() > 24:
        raise InputError(path, "layout", "the right half is no grey depth map")
    return np.ascontiguousarray(rgb[:, :width]), depth.mean(2, dtype=np.float32) / 255


def surface(colour: U8, depth: F32, *, stack: PanelStack, depth_m: tuple[float, float]) -> Part:
    """The picture as triangles: each point on its ray from the nominal eye, at its depth; torn at edges."""
    height, width = depth.shape
    columns = min(COLUMNS, width)
    rows = max(round(height * columns / width), 2)
    coarse = cv2.resize(depth, (columns, rows), interpolation=cv2.INTER_NEAREST)
    plane = screen(stack, width_px=columns, height_px=rows)
    u, v = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    # The outermost samples stand for the picture's edge.
    u[:, 0], u[:, -1], v[0], v[-1] = 0.0, columns, 0.0, rows
    x = depth_m[0] + coarse.astype(np.float64) * (depth_m[1] - depth_m[0])
    spread = (NOMINAL_DISTANCE_M - x) / NOMINAL_DISTANCE_M
    y = (plane.left_m + u * plane.pitch_u_m) * spread
    z = (plane.top_m - v * plane.pitch_v_m) * spread
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    quads = np.column_stack([corner, corner + columns, corner + 1, corner + columns + 1])
    steps = np.ptp(coarse.reshape(-1)[quads], axis=1)
    quads = quads[steps <= TORN_RELATIVE]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [2, 1, 3]]]).astype(np.int32)
    positions = np.stack([x, y, z], axis=2).reshape(-1, 3).astype(np.float32)
    uv = np.stack([u / columns, v / rows], axis=2).reshape(-1, 2).astype(np.float32)
    normals = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(positions), 1))
    return Part(Shape(positions, normals, uv, triangles), picture=rgba_from_rgb(colour), lit=False)


class RgbdSource(DrawingSource):
    """A picture with depth between two planes of the stack frame."""

    def __init__(
        self,
        rgb: U8,
        *,
        path: Path,
        stack: PanelStack,
        depth_m: tuple[float, float],
        context: Any,
        background: tuple[float, float, float],
    ) -> None:
        colour, depth = split_rgbd(rgb, path)
        part = surface(colour, depth, stack=stack, depth_m=depth_m)
        # Outlines of a torn surface run through its inside: no ramps there.
        self.draws_in = context
        self._painter = TrianglePainter([part], context=context, background=background, samples=1)
        low, high = float(part.shape.positions_m[:, 0].min()), float(part.shape.positions_m[:, 0].max())
        self.info = ContentInfo(
            name=path.stem, depth_range_m=(low, high), background=background, left_out=("lights", "sorting")
        )

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        return self._painter.paint(view, [np.eye(4)])

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        return self._painter.extent(view, [np.eye(4)])

    def close(self) -> None:
        self._painter.close()
