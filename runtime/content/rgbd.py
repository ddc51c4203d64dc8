"""Draw a picture with depth (colour and a grey depth map, side by side) as two surfaces.

The front surface shows the picture and is split where the depth jumps, where the foreground would be stretched. The
second one fills the hole that a viewer would see when looking past such an edge with a background invented from the
depths and colours next to the edge. Everywhere, colours are (h, w, 3), and depths (h, w) from 0 (rear) to 1 (front).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from runtime.content.base import ContentInfo
from runtime.content.frames import open_frames
from runtime.content.images import rgba_from_rgb
from runtime.content.parts import Part
from runtime.content.pictures import screen
from runtime.content.placing import SceneFile
from runtime.content.shapes import I32, Shape
from runtime.content.triangles import DrawnPart, TriangleSource
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8

COLUMNS = 320  # resolution of smooth areas: as fine as a depth camera's, and fast without a GPU
FINEST_COLUMNS = 1600  # finest resolution at edges
NOMINAL_DISTANCE_M = 0.6  # viewing distance at which the surface looks exactly like the picture
TORN_RELATIVE = 0.12  # a step between neighbours is an edge if it exceeds this share of the depth range
BLURRED_PX = 5  # width over which the depth map's edges may be blurred
MIXED_PX = 2  # colours within this distance from an edge may be a mixture of both sides
REACH_PX = 10  # a mixed colour is replaced by a colour at most this far away
BEHIND_SHARE = 0.1  # width of the background invented behind an edge, as a share of the picture's width
SET_BACK = 0.004  # shift of the invented surface to the rear, as a share of the depth range
SAMPLES = 4  # samples per pixel, to smooth split edges

Mask = NDArray[np.bool_]


def split_rgbd(rgb: U8, path: Path) -> tuple[U8, F32]:
    """Split a picture into colour (left half) and depth. Raises InputError if the right is not grey."""
    width = rgb.shape[1] // 2
    if width < 2 or rgb.shape[0] < 2:
        raise InputError(path, "layout", "the picture is too small to contain colour and depth side by side")
    depth = rgb[:, width : 2 * width]
    if np.ptp(depth[::4, ::4].astype(np.int16), axis=2).max() > 24:
        raise InputError(path, "layout", "the right half is not a grey depth map")
    return np.ascontiguousarray(rgb[:, :width]), depth.mean(2, dtype=np.float32) / 255


def surfaces(colour: U8, depth: F32, *, stack: PanelStack, depth_m: tuple[float, float]) -> list[Part]:
    """Return the front surface and, if there are edges, the background. Depths 0 and 1 are at x =
    `depth_m` in `stack`. Each point is on the ray from the nominal eye position through its pixel of the picture, which
    is fitted to the panels.
    """
    depth = sharpened(depth)
    colour = unmixed(colour, depth)
    height, width = depth.shape
    if width > FINEST_COLUMNS:
        rows = max(round(height * FINEST_COLUMNS / width), 2)
        depth = np.asarray(cv2.resize(depth, (FINEST_COLUMNS, rows), interpolation=cv2.INTER_NEAREST), np.float32)
    parts = [_placed(depth, _quads(depth), rgba_from_rgb(colour), stack=stack, depth_m=depth_m)]
    columns = min(COLUMNS, depth.shape[1])
    size = (columns, max(round(depth.shape[0] * columns / depth.shape[1]), 2))
    coarse = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
    coloured = np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    behind, filled, made_up = background(coarse, coloured)
    row, column = np.nonzero(made_up[:-1, :-1])
    quads = _corners(row, column, size[0])
    if len(quads):
        quads = quads[made_up.reshape(-1)[quads].all(1) & (np.ptp(behind.reshape(-1)[quads], axis=1) <= TORN_RELATIVE)]
    if len(quads):
        parts.append(_placed(behind - SET_BACK, quads, rgba_from_rgb(filled), stack=stack, depth_m=depth_m))
    return parts


def sharpened(depth: F32) -> F32:
    """Sharpen a depth map: pixels in blurred edges get the near or the far depth, as is closer."""
    kernel = np.ones((BLURRED_PX, BLURRED_PX), np.uint8)
    high, low = cv2.dilate(depth, kernel), cv2.erode(depth, kernel)
    snapped = np.where(high - depth < depth - low, high, low)
    return np.where(high - low > TORN_RELATIVE, snapped, depth).astype(np.float32)


def unmixed(colour: U8, depth: F32) -> U8:
    """Replace colours next to depth edges, which may mix both sides, by colours farther from the edge."""
    side = 2 * MIXED_PX + 1
    kernel = np.ones((side, side), np.uint8)
    mixed = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > TORN_RELATIVE
    beside = cv2.dilate(mixed.astype(np.uint8), np.ones((2 * side + 1, 2 * side + 1), np.uint8)).astype(bool) & ~mixed
    if not beside.any():
        return colour
    there, wanted = np.argwhere(beside), np.argwhere(mixed)
    far_apart = 4 * side / TORN_RELATIVE  # pixels per unit of depth, to keep the other side from being nearest
    away, nearest = cKDTree(np.column_stack([there, depth[beside] * far_apart])).query(
        np.column_stack([wanted, depth[mixed] * far_apart]), distance_upper_bound=REACH_PX
    )
    near = np.isfinite(away)  # parts too thin to have a clean inside keep their colours
    result = colour.copy()
    result[tuple(wanted[near].T)] = colour[beside][nearest[near]]
    return result


def background(depth: F32, colour: U8) -> tuple[F32, U8, Mask]:
    """Invent the background behind depth edges: its depth, its colour, and the mask (h, w) of its pixels.
    The far side is continued behind the near side. The mask also includes a band of the far side, to close gaps.
    """
    far_side = depth < cv2.dilate(depth, np.ones((5, 5), np.uint8)) - TORN_RELATIVE
    if not far_side.any():
        return depth, colour, far_side
    distance, (row, column) = distance_transform_edt(~far_side, return_indices=True)
    behind = depth[row, column]
    under = (distance <= BEHIND_SHARE * depth.shape[1]) & (depth - behind > TORN_RELATIVE / 2)
    return behind, colour[row, column], far_side | under


def _quads(depth: F32) -> I32:
    """Divide a depth map into quads (n, 4) of flat indices, large in smooth areas, none across edges."""
    rows, columns = depth.shape
    step = -(-columns // COLUMNS)
    down = np.unique(np.r_[np.arange(0, rows - 1, step), rows - 1])
    across = np.unique(np.r_[np.arange(0, columns - 1, step), columns - 1])
    kernel = np.ones((3, 3), np.uint8)
    edges = (cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > TORN_RELATIVE).astype(np.uint8)
    cells = np.maximum.reduceat(np.maximum.reduceat(edges, down[:-1], axis=0), across[:-1], axis=1).astype(bool)
    i, j = np.nonzero(~cells)
    large = np.column_stack([down[i + below] * columns + across[j + right] for right in (0, 1) for below in (0, 1)])
    fine = np.repeat(np.repeat(cells, np.diff(down), axis=0), np.diff(across), axis=1)
    row, column = np.nonzero(fine)
    small = _corners(row, column, columns)
    small = small[np.ptp(depth.reshape(-1)[small], axis=1) <= TORN_RELATIVE] if len(small) else small
    return np.concatenate([large, small]).astype(np.int32)


def _corners(row: Any, column: Any, columns: int) -> I32:
    first = row * columns + column
    return np.column_stack([first, first + columns, first + 1, first + columns + 1]).astype(np.int32)


def _placed(depth: F32, quads: I32, picture: U8, *, stack: PanelStack, depth_m: tuple[float, float]) -> Part:
    """Convert a depth map's quads to triangles in frame `stack`, with the picture as their texture."""
    rows, columns = depth.shape
    used, corners = np.unique(quads, return_inverse=True)
    corners = corners.reshape(-1, 4)
    plane = screen(stack, width_px=columns, height_px=rows)
    u, v = _edge_to_edge(used % columns, columns), _edge_to_edge(used // columns, rows)
    x = depth_m[0] + depth.reshape(-1)[used].astype(np.float64) * (depth_m[1] - depth_m[0])
    spread = (NOMINAL_DISTANCE_M - x) / NOMINAL_DISTANCE_M
    y = (plane.left_m + u * plane.pitch_u_m) * spread
    z = (plane.top_m - v * plane.pitch_v_m) * spread
    positions = np.column_stack([x, y, z]).astype(np.float32)
    normals = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(positions), 1))
    uv = np.column_stack([u / columns, v / rows]).astype(np.float32)
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [2, 1, 3]]]).astype(np.int32)
    return Part(Shape(positions, normals, uv, triangles), picture=picture, lit=False)


def _edge_to_edge(index: Any, count: int) -> F64:
    """Return pixel centre coordinates, with those of the outermost pixels moved to the edge."""
    place = index + 0.5
    return np.where(index == 0, 0.0, np.where(index == count - 1, float(count), place))


def prepare(file: SceneFile) -> Callable[..., TriangleSource]:
    """Read a picture with depth, and return a function that creates the source in a GL context. Raises
    InputError if the picture cannot be read or its right half is not a depth map.
    """
    colour, depth = split_rgbd(open_frames(file.path, file.settings).frame(0), file.path)
    # A split surface also has edges inside its outline, so it needs multisampling instead of ramps.
    surface_parts = surfaces(colour, depth, stack=file.stack, depth_m=file.settings.depth_m)
    parts = [DrawnPart(part, outlined=False) for part in surface_parts]
    info = ContentInfo(file.path.stem, background=file.background)
    places = [np.eye(4)] * len(parts)
    return partial(TriangleSource, parts, places, info=info, samples=SAMPLES)
