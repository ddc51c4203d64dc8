"""Homographies that correct the layers of tilted panels for an eye's position.

For each panel, there is an ideal panel, which is parallel to the others and at the nominal x_m. Registration from
photographs maps every layer pixel to the point where an eye at `seen_from_m` sees it on the ideal panel. Seen from
anywhere else, including the other eye's position, the pixels of a tilted panel appear displaced.

A ray from the eye through a point on the ideal panel meets the tilted plane at a point q. The line from `seen_from_m`
through q meets the ideal panel at the layer pixel that the eye sees. Both steps are projections from one plane to
another, so together they form a homography. It is affine if the eye and `seen_from_m` are equally far from the panel.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from runtime.optics.stack import PanelStack, PlaneRaster, Tilt
from runtime.records import F64

Triple = tuple[float, float, float]
UNSEEN_PX = 0.05  # displacements smaller than this, in panel pixels, are ignored


def layer_from_seen(stack: PanelStack, index: int, eye_m: F64) -> F64:
    """Return the 3x3 homography from the ideal panel's points (y, z, 1) to the layer's points (y, z, 1)."""
    if stack.tilt is None or not any(stack.tilt.depth[index]):
        return np.eye(3)
    return _projected(stack.tilt.depth[index], stack.tilt.seen_from_m, _triple(eye_m), stack.x_m[index])


def layer_pixels_from_seen(raster: PlaneRaster, layer_from_seen_m: F64) -> F64:
    """Convert a `layer_from_seen` homography from metres to raster pixels."""
    return raster.raster_from_plane() @ layer_from_seen_m @ raster.plane_from_raster()


def seen_on_layers(panels_from: F64, stack: PanelStack, eyes_m: F64) -> F64:
    """Continue homographies (..., N, 3, 3) to ideal panels' pixels to what eyes (..., 3) see of layers."""
    if stack.tilt is None:
        return panels_from
    moved = np.empty_like(panels_from)
    for place in np.ndindex(*panels_from.shape[:-2]):
        layer_from_panel = layer_from_seen(stack, place[-1], eyes_m[place[:-1]])
        moved[place] = layer_pixels_from_seen(stack.panel(place[-1]), layer_from_panel) @ panels_from[place]
    return moved


def coarse_layer_from_seen(stack: PanelStack, index: int, eye_m: F64) -> F64:
    """Return the simplest map that approximates `layer_from_seen` to `UNSEEN_PX` at nine points of the
    panel. Candidates: the identity, a scale and shift (fast to resample), an affine map, and the exact homography.
    """
    if stack.tilt is None or not any(stack.tilt.depth[index]):
        return np.eye(3)
    return _simplified(
        stack.tilt,
        index,
        stack.x_m[index],
        _triple(eye_m),
        (stack.width_m, stack.height_m, min(stack.width_m / stack.width_px, stack.height_m / stack.height_px)),
    )


def _triple(point_m: F64) -> Triple:
    x, y, z = map(float, point_m)
    return x, y, z


@lru_cache(maxsize=64)
def _projected(
    depth: tuple[float, float, float],
    seen_from: tuple[float, float, float],
    eye: tuple[float, float, float],
    x_m: float,
) -> F64:
    """Return the map of x = x_m onto the tilted plane along rays from `eye`, and back from `seen_from`."""
    offset_m, right, up = depth
    normal, far = np.array([1.0, -right, -up]), x_m + offset_m
    origin, place = np.array(seen_from), np.array(eye)
    ideal = np.array([[0.0, 0.0, x_m], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # (x, y, z) from (y, z, 1)
    weight = normal @ ideal - [0.0, 0.0, normal @ place]
    ray = ideal - np.outer(place, [0.0, 0.0, 1.0])
    point = np.outer(place, weight) + ray * (far - normal @ place)  # point on the tilted plane, times `weight`
    ahead = point[0] - origin[0] * weight
    sideways = np.outer(origin[1:], ahead) + (point[1:] - np.outer(origin[1:], weight)) * (x_m - origin[0])
    matrix = np.vstack([sideways, ahead])
    return np.asarray(matrix / matrix[2, 2], dtype=np.float64)


@lru_cache(maxsize=64)
def _simplified(tilt: Tilt, index: int, x_m: float, eye: Triple, size: Triple) -> F64:
    width_m, height_m, pitch_m = size
    exact = _projected(tilt.depth[index], tilt.seen_from_m, eye, x_m)
    corners = np.array(
        [[y, z, 1.0] for y in (-width_m / 2, 0.0, width_m / 2) for z in (-height_m / 2, 0.0, height_m / 2)]
    )
    moved = corners @ exact.T
    moved = moved[:, :2] / moved[:, 2:]
    (y, z, one), zero = corners.T, np.zeros(len(corners))
    scale_and_shift = (y, zero, one), (zero, z, one)
    affine = (y, z, one), (y, z, one)
    for columns in (None, scale_and_shift, affine):
        matrix = np.eye(3)
        if columns is not None:
            for axis, terms in enumerate(columns):
                matrix[axis] = np.linalg.lstsq(np.column_stack(terms), moved[:, axis], rcond=None)[0]
        off_m = np.abs(corners @ matrix[:2].T - moved).max()
        if off_m <= UNSEEN_PX * pitch_m:
            return matrix
    return exact
