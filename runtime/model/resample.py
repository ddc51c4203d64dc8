"""Resampling between rasters on parallel planes, as one eye sees them: a scale and a shift.

OpenCV's `resize` is two to four times as fast as its `warpAffine`, and finer (1/2048 against 1/32 pixel), but
knows no shift. So the result is begun at a pixel whose place in the source is nearly a whole number; what lies
beside it is warped. Rasters that are also sheared (a tilted head, a tilted panel) are warped altogether, and those
whose columns are not evenly spaced (a turned head) by a map of every pixel.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.model.chain import EVEN_COLUMNS, ColumnLaw
from runtime.optics.stack import PlaneRaster
from runtime.optics.views import relative_scale_shift
from runtime.records import F64

MARGIN = 4  # pixels to spare, right and below, in buffers that are resampled into
MARGIN_NUMBERS = 64  # to spare to the right: compiled loops read whole pieces of a row
SEARCH = 96  # pixels among which a whole place in the source is looked for
GOOD_PHASE = 1 / 24  # of a pixel: the search ends here; so small a shift leaves an error below -55 dB
LEAST_RUN = 8  # pixels of source and result that are worth resizing
NODE_PX = 4  # of a result: what lies between errs by a hundredth of a pixel, by a twentieth beside a head turned far
WORST_PHASE = 1 / 12  # where nothing better is found

Image = NDArray[Any]
_BESIDE_SCALE_AND_SHIFT = (np.array([0, 1, 2, 2]), np.array([1, 0, 0, 1]))


def target_from_source(eye_m: ArrayLike, *, source: PlaneRaster, target: PlaneRaster) -> F64:
    """3x3: pixels of `target` hit by the eye's rays through pixels of `source`; both parallel to the panels."""
    scale, shift_m = relative_scale_shift(eye_m, from_x_m=source.x_m, to_x_m=target.x_m)
    across = np.array([[scale, 0.0, shift_m[0]], [0.0, scale, shift_m[1]], [0.0, 0.0, 1.0]])
    found: F64 = target.raster_from_plane() @ across @ source.plane_from_raster()
    return found


def buffer(height_px: int, width_px: int, dtype: Any = np.int16, *, channels: int = 3) -> Image:
    """An (height, width, 3) array, or (height, width) for one channel, that `resample` can write into.

    It is a view with margins.
    """
    shape = (height_px + MARGIN, width_px + max(MARGIN, -(-MARGIN_NUMBERS // channels)))
    return np.zeros(shape if channels == 1 else (*shape, channels), dtype)[:height_px, :width_px]


def resample(
    image: Image,
    *,
    image_from_result: F64,
    out: Image,
    outside: int = 0,
    cubic: bool = False,
    image_columns: ColumnLaw = EVEN_COLUMNS,
    result_columns: ColumnLaw = EVEN_COLUMNS,
) -> Image:
    """Bilinear (or bicubic) samples of an (h, w, C) or (h, w) image at the positions of a raster, into `out`.

    image_from_result: 3x3, last entry 1, pixel centres at half-integers, between what the two laws make of columns.
    `out` comes from `buffer`. Beside the image the result is `outside` (axis-aligned rasters) or its repeated edge
    (all others): no ray through there crosses every panel, so that nobody sees it.
    """
    flags = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    if image_columns.bend or result_columns.bend:
        columns, rows = _places(image_from_result, out.shape[:2], image_columns, result_columns)
        if cubic:  # twice as fine and then linear: by places, OpenCV's own kernel takes five times as long
            image = cv2.resize(image, None, fx=2, fy=2, interpolation=flags)
            columns, rows = 2 * columns + 0.5, 2 * rows + 0.5
        cv2.remap(image, columns, rows, cv2.INTER_LINEAR, dst=out, borderMode=cv2.BORDER_REPLICATE)
        return out
    if np.count_nonzero(image_from_result[_BESIDE_SCALE_AND_SHIFT]) == 0:
        across = _whole_place(image_from_result[0, 0], image_from_result[0, 2], image.shape[1], out.shape[1])
        down = _whole_place(image_from_result[1, 1], image_from_result[1, 2], image.shape[0], out.shape[0])
        if across is not None and down is not None:
            return _resized(image, image_from_result, out, across, down, flags, outside)
    return _warped(image, image_from_result, out, 0, 0, *out.shape[1::-1])


def _places(matrix: F64, size: tuple[int, ...], image_columns: ColumnLaw, result_columns: ColumnLaw) -> list[Image]:
    """(h, w) float32 each: columns and rows of the image for every pixel of the result, with pixel centres at integers;
    worked out at every `NODE_PX`th and between them linear."""
    height, width = size
    columns, rows = (NODE_PX * (np.arange(-(-count // NODE_PX) + 2) - 0.5) for count in (width, height))
    u, v = result_columns.homography_from_column(columns), rows[:, None]
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
    nodes = image_columns.column_from_homography(x / w), y / w
    whole = [cv2.resize((place - 0.5).astype(np.float32), None, fx=NODE_PX, fy=NODE_PX) for place in nodes]
    return [place[NODE_PX : NODE_PX + height, NODE_PX : NODE_PX + width] for place in whole]


def _whole_place(scale: float, shift: float, source_px: int, result_px: int) -> tuple[int, int, int, int] | None:
    """(first result pixel inside the source, first to resize, its source pixel, how many) or None: warp instead."""
    if scale <= 0.0:
        return None
    first = max(0, int(np.ceil(-shift / scale - 1e-9)))
    places = (first + np.arange(SEARCH)) * scale + shift
    errors = np.abs(places - np.rint(places))
    best = int(np.argmax(errors < GOOD_PHASE))
    if errors[best] >= GOOD_PHASE:
        best = int(np.argmin(errors))
        if errors[best] > WORST_PHASE:
            return None
    start, source = first + best, int(np.rint(places[best]))
    count = min(source_px - source, int(np.ceil((result_px - start) * scale)) + 1)
    if count < LEAST_RUN or result_px - start < LEAST_RUN or count < LEAST_RUN * scale:
        return None
    return first, start, source, count


def _resized(
    image: Image,
    matrix: F64,
    out: Image,
    across: tuple[int, int, int, int],
    down: tuple[int, int, int, int],
    flags: int,
    outside: int,
) -> Image:
    (first_u, u0, su, columns), (first_v, v0, sv, rows) = across, down
    fx, fy = 1.0 / matrix[0, 0], 1.0 / matrix[1, 1]
    parent = out.base
    assert isinstance(parent, np.ndarray)
    width, height = round(columns * fx), round(rows * fy)
    # The counts end at most one source pixel past the result: more than the margin only when magnified.
    while u0 + width > parent.shape[1]:
        columns -= 1
        width = round(columns * fx)
    while v0 + height > parent.shape[0]:
        rows -= 1
        height = round(rows * fy)
    target = parent[v0 : v0 + height, u0 : u0 + width]
    cv2.resize(image[sv : sv + rows, su : su + columns], None, dst=target, fx=fx, fy=fy, interpolation=flags)
    h, w = out.shape[:2]
    right, below = min(w, u0 + width), min(h, v0 + height)
    # What lies before the middle of the first source pixel was repeated from it: draw that again.
    u1, v1 = u0 + _repeated(matrix[0, 0], su), v0 + _repeated(matrix[1, 1], sv)
    for x0, y0, x1, y1 in ((first_u, first_v, right, v1), (first_u, v1, u1, below)):
        if x1 > x0 and y1 > y0:
            _warped(image, matrix, out, x0, y0, x1, y1)
    out[:first_v] = outside
    out[below:] = outside
    out[first_v:below, :first_u] = outside
    out[first_v:below, right:] = outside
    return out


def _repeated(scale: float, source: int) -> int:
    """Result pixels at the beginning of a resized part that needed the source pixel before it."""
    return max(0, int(np.ceil(0.5 / scale - 0.5 - WORST_PHASE))) if source > 0 else 0


def _warped(image: Image, matrix: F64, out: Image, x0: int, y0: int, x1: int, y1: int) -> Image:
    flags, edge, size = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE, (x1 - x0, y1 - y0)
    # OpenCV puts pixel centres at integers.
    if matrix[2, 0] == 0.0 and matrix[2, 1] == 0.0:
        affine = matrix[:2].copy()
        affine[:, 2] += matrix[:2, :2] @ (x0 + 0.5, y0 + 0.5) - 0.5
        out[y0:y1, x0:x1] = cv2.warpAffine(image, affine, size, flags=flags, borderMode=edge)
    else:
        to_corners = np.array([[1.0, 0.0, x0 + 0.5], [0.0, 1.0, y0 + 0.5], [0.0, 0.0, 1.0]])
        to_centres = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
        whole = to_centres @ matrix @ to_corners
        out[y0:y1, x0:x1] = cv2.warpPerspective(image, whole, size, flags=flags, borderMode=edge)
    return out
