"""Resampling between rasters on parallel planes, as one eye sees them: a scale and a shift.

OpenCV's `resize` is two to four times as fast as its `warpAffine`, and finer (1/2048 against 1/32 pixel), but
knows no shift. So the result is begun at a pixel whose place in the source is a whole number, to 1/64 pixel; what
lies beside it is warped. Rasters that are also sheared (a tilted head) are warped altogether.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.optics.stack import PlaneRaster
from runtime.optics.views import relative_scale_shift
from runtime.records import F64

MARGIN = 4  # pixels to spare, right and below, in buffers that are resampled into
SEARCH = 96  # pixels among which a whole place in the source is looked for
PHASE_TOLERANCE = 1 / 64

Image = NDArray[Any]


def target_from_source(eye_m: ArrayLike, *, source: PlaneRaster, target: PlaneRaster) -> F64:
    """3x3: pixels of `target` hit by the eye's rays through pixels of `source`; both parallel to the panels."""
    scale, shift_m = relative_scale_shift(eye_m, from_x_m=source.x_m, to_x_m=target.x_m)
    across = np.array([[scale, 0.0, shift_m[0]], [0.0, scale, shift_m[1]], [0.0, 0.0, 1.0]])
    return target.raster_from_plane() @ across @ source.plane_from_raster()


def buffer(height_px: int, width_px: int, dtype: Any = np.int16) -> Image:
    """An (height, width, 3) array that `resample` can write into: a view with margins."""
    return np.zeros((height_px + MARGIN, width_px + MARGIN, 3), dtype)[:height_px, :width_px]


def resample(image: Image, *, image_from_result: F64, out: Image, cubic: bool = False) -> Image:
    """Bilinear (or bicubic) samples of an (h, w, C) image at the positions of a raster, into `out`; edges repeated.

    image_from_result: 3x3 affine, pixel centres at half-integers. `out` comes from `buffer`.
    """
    flags = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    if image_from_result[0, 1] == 0.0 and image_from_result[1, 0] == 0.0:
        across = _whole_place(image_from_result[0, 0], image_from_result[0, 2], image.shape[1], out.shape[1])
        down = _whole_place(image_from_result[1, 1], image_from_result[1, 2], image.shape[0], out.shape[0])
        if across is not None and down is not None:
            return _resized(image, image_from_result, out, across, down, flags)
    return _warped(image, image_from_result, out, 0, 0, *out.shape[1::-1])


def _whole_place(scale: float, shift: float, source_px: int, result_px: int) -> tuple[int, int, int] | None:
    """(first result pixel, its source pixel, how many source pixels) or None where there is none."""
    if scale <= 0.0:
        return None
    first = max(0, int(np.ceil(-shift / scale - 1e-9)))
    places = (first + np.arange(SEARCH)) * scale + shift
    errors = np.abs(places - np.rint(places))
    best = int(np.argmax(errors < PHASE_TOLERANCE / 2))
    if errors[best] >= PHASE_TOLERANCE / 2:
        best = int(np.argmin(errors))
        if errors[best] > PHASE_TOLERANCE:
            return None
    start, source = first + best, int(np.rint(places[best]))
    count = min(source_px - source, int(np.ceil((result_px - start) * scale)) + 1)
    if count < 8 or result_px - start < 8:
        return None
    return start, source, count


def _resized(
    image: Image, matrix: F64, out: Image, across: tuple[int, int, int], down: tuple[int, int, int], flags: int
) -> Image:
    (u0, su, columns), (v0, sv, rows) = across, down
    fx, fy = 1.0 / matrix[0, 0], 1.0 / matrix[1, 1]
    width, height = round(columns * fx), round(rows * fy)
    parent = out.base
    assert isinstance(parent, np.ndarray)
    # Never more than the margin: `count` above ends at most one source pixel past the result.
    if u0 + width > parent.shape[1] or v0 + height > parent.shape[0]:
        columns, rows = columns - 1, rows - 1
        width, height = round(columns * fx), round(rows * fy)
    target = parent[v0 : v0 + height, u0 : u0 + width]
    done = cv2.resize(image[sv : sv + rows, su : su + columns], None, dst=target, fx=fx, fy=fy, interpolation=flags)
    if done is not target and not np.shares_memory(done, target):
        target[...] = done[: target.shape[0], : target.shape[1]]
    h, w = out.shape[:2]
    right, below = min(w, u0 + width), min(h, v0 + height)
    for x0, y0, x1, y1 in ((0, 0, w, v0), (0, below, w, h), (0, v0, u0, below), (right, v0, w, below)):
        if x1 > x0 and y1 > y0:
            _warped(image, matrix, out, x0, y0, x1, y1)
    return out


def _warped(image: Image, matrix: F64, out: Image, x0: int, y0: int, x1: int, y1: int) -> Image:
    # OpenCV puts pixel centres at integers.
    affine = matrix[:2].copy()
    affine[:, 2] += matrix[:2, :2] @ (x0 + 0.5, y0 + 0.5) - 0.5
    out[y0:y1, x0:x1] = cv2.warpAffine(
        image,
        affine,
        (x1 - x0, y1 - y0),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return out
