"""Tilted panels: where on a layer an eye sees what it would see on the ideal panel.

Registration by photographs puts every pixel of a layer where an eye at `seen_from_m` sees it on the ideal panel
(parallel, at its x_m). Another eye, also the other one of the same head, sees a tilted panel's pixels elsewhere: its
ray crosses the tilted plane, and the line from `seen_from_m` through that point crosses the ideal one at the layer's
pixel. Both are projections between planes, so that together they are a homography; for eyes as far away as
`seen_from_m` it is affine.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from runtime.optics.stack import PanelStack, PlaneRaster, Tilt
from runtime.records import F64

Triple = tuple[float, float, float]
UNSEEN_PX = 0.05  # of a panel's pixels: what moves less is left out


def layer_from_seen(stack: PanelStack, index: int, eye_m: F64) -> F64:
    """3x3 from (y, z, 1) of the ideal panel to the layer's, as seen by an eye (3,).

    The identity where the stack has no tilt.
    """
    if stack.tilt is None or not any(stack.tilt.depth[index]):
        return np.eye(3)
    return _projected(stack.tilt.depth[index], stack.tilt.seen_from_m, _triple(eye_m), stack.x_m[index])


def layer_pixels_from_seen(raster: PlaneRaster, layer_from_seen_m: F64) -> F64:
    """The same 3x3 in a raster's pixels."""
    return raster.raster_from_plane() @ layer_from_seen_m @ raster.plane_from_raster()


def coarse_layer_from_seen(stack: PanelStack, index: int, eye_m: F64) -> F64:
    """`layer_from_seen`, to `UNSEEN_PX` at the panel's corners and as simple as that allows.

    Simplest first: the identity, a scale and a shift (fast to resample), affine, a homography.
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


def _triple(place_m: F64) -> Triple:
    x, y, z = map(float, place_m)
    return x, y, z


@lru_cache(maxsize=64)
def _projected(
    depth: tuple[float, float, float],
    seen_from: tuple[float, float, float],
    eye: tuple[float, float, float],
    x_m: float,
) -> F64:
    """From the ideal plane along an eye's rays to the tilted plane, and back along those of `seen_from`."""
    offset_m, right, up = depth
    normal, far = np.array([1.0, -right, -up]), x_m + offset_m
    origin, place = np.array(seen_from), np.array(eye)
    ideal = np.array([[0.0, 0.0, x_m], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # (x, y, z) from (y, z, 1)
    weight = normal @ ideal - [0.0, 0.0, normal @ place]
    ray = ideal - np.outer(place, [0.0, 0.0, 1.0])
    point = np.outer(place, weight) + ray * (far - normal @ place)  # times weight
    ahead = point[0] - origin[0] * weight
    beside = np.outer(origin[1:], ahead) + (point[1:] - np.outer(origin[1:], weight)) * (x_m - origin[0])
    matrix = np.vstack([beside, ahead])
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
