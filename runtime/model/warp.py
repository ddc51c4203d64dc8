"""Resample pictures and panels to other rasters."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.kernels import EDGE_PX, library
from runtime.model.chain import EVEN_COLUMNS, ColumnLaw
from runtime.model.geometry import SNAPPED, TargetView
from runtime.optics.stack import PlaneRaster, between_pixel_centres
from runtime.records import F64, I16, U8
from runtime.support.threads import on_rows

# Minimum width and height of a resized picture, and minimum number of old pixels per new pixel. Enlarging a picture
# further would add no information.
LEAST_PX, MIN_SCALE = 16, 0.25
REACH_PX = EDGE_PX - 1.0  # maximum distance that an image's edge is repeated outwards
_TRANSPOSED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def source_px(image_from_raster: F64, size: tuple[int, int]) -> tuple[float, float]:
    """Return how many image pixels a pixel spans, right and down, at a (width, height) raster's centre."""
    a = image_from_raster
    x, y, w = a @ (size[0] / 2, size[1] / 2, 1.0)
    across, down = np.linalg.norm((a[:2, :2] - np.outer((x / w, y / w), a[2, :2])) / w, axis=0)
    return float(across), float(down)


def resized_px(pixels: int, scale: float) -> int:
    """Return the number of new pixels for `pixels` old pixels if each new pixel covers `scale` old ones."""
    return max(min(pixels, LEAST_PX), round(pixels / max(scale, MIN_SCALE)))


def reduced_view(view: TargetView, middle: PlaneRaster, reduction: int) -> TargetView:
    """Average a picture to about one pixel per `reduction` x `reduction` pixels of the middle panel."""
    picture = view.pixels
    picture_from_middle = np.linalg.inv(view.plane_from_picture) @ middle.plane_from_raster()
    scales = source_px(picture_from_middle, (middle.width_px, middle.height_px))
    height, width = picture.shape[:2]
    by_u, by_v = (
        max(1, min(round(scale * reduction), px // LEAST_PX)) for scale, px in zip(scales, (width, height), strict=True)
    )
    if (by_u, by_v) == (1, 1):
        return TargetView(picture, view.plane_from_picture)
    # Crop to a multiple of the factors, because OpenCV is ten times as fast at shrinking by whole factors.
    cropped = picture[: height // by_v * by_v, : width // by_u * by_u]
    small = cv2.resize(cropped, (width // by_u, height // by_v), interpolation=cv2.INTER_AREA)
    return TargetView(np.asarray(small, np.uint8), view.plane_from_picture @ np.diag([by_u, by_v, 1.0]))


def picture_on(
    view: TargetView, middle: PlaneRaster, *, middle_from_result: F64, edge: int, size: tuple[int, int]
) -> U8:
    """Resample a view's picture to a raster of (rows, columns), unless its pixels already coincide.
    `middle` is the middle panel's grid, `middle_from_result` the map to it, and `edge` OpenCV's border mode.
    """
    picture_from_result = np.linalg.inv(view.plane_from_picture) @ middle.plane_from_raster() @ middle_from_result
    picture_from_result = picture_from_result / picture_from_result[2, 2]
    if view.picture.shape[:2] == size and np.abs(picture_from_result - np.eye(3)).max() < SNAPPED:
        return view.pixels
    return np.asarray(resample(view.pixels, picture_from_result, size=size, edge=edge), np.uint8)


def resample(
    image: NDArray[Any], image_from_result: F64, *, size: tuple[int, int], edge: int = cv2.BORDER_CONSTANT
) -> NDArray[Any]:
    """Sample an (h, w[, C]) image bilinearly at (rows, columns), with OpenCV's border mode."""
    at_centres = between_pixel_centres(image_from_result)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(image, at_centres, size[::-1], flags=flags, borderMode=edge))


def warp(
    image: I16,
    image_from_result: F64,
    *,
    size: tuple[int, int],
    outside: int,
    reach_px: float = REACH_PX,
    image_columns: ColumnLaw = EVEN_COLUMNS,
    result_columns: ColumnLaw = EVEN_COLUMNS,
    threads: int | None = None,
) -> I16:
    """Resample an (h, w[, 3]) int16 image, clipped to ±8160, several times as fast as `resample`.

    The 3x3 homography maps columns, as the coordinates t of the column laws, of which one must be even, and rows of the
    result, `size` (rows, columns), to the image's. Edges are repeated outwards for `reach_px`, at most `REACH_PX`;
    beyond, the value is `outside`. There are as many threads as OpenCV uses, unless given.
    """
    x, y, w = image_from_result @ (result_columns.middle or size[1] / 2, size[0] / 2, 1.0)
    right, down = image_from_result[:2, 0] - np.array([x, y]) / w * image_from_result[2, 0]
    turned = abs(down) > abs(right)  # the compiled loop requires the result's and the image's rows to run the same way
    if turned and result_columns.bend:
        image, image_from_result, turned = np.swapaxes(image, 0, 1), _TRANSPOSED @ image_from_result, False
    elif turned:
        image_from_result, size = image_from_result @ _TRANSPOSED, size[::-1]
    if _runs_left(image_from_result, result_columns.middle or size[1] / 2, size[0] / 2):
        # The loop samples in tiles only if the result's columns run to the right in the image.
        width_px = image.shape[1]
        image = np.asarray(cv2.flip(np.ascontiguousarray(image), 1), np.int16)
        image_from_result = np.array([[-1.0, 0.0, width_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ image_from_result
        image_columns = image_columns.mirrored(width_px)
    source, result = library().Source(np.ascontiguousarray(image)), np.empty((*size, *image.shape[2:]), np.int16)
    laws = (image_columns.bend, image_columns.middle), (result_columns.bend, result_columns.middle)
    matrix = np.ascontiguousarray(image_from_result, np.float64)
    on_rows(lambda *rows: source.warp(result, matrix, *laws, reach_px, outside, rows), size[0], threads=threads)
    return np.ascontiguousarray(np.swapaxes(result, 0, 1)) if turned else result


def _runs_left(image_from_result: F64, u: float, v: float) -> bool:
    """Return True if, at a given result pixel, the image column decreases as the result column increases."""
    x, _, w = image_from_result @ (u, v, 1.0)
    return bool((image_from_result[0, 0] * w - x * image_from_result[2, 0]) < 0)
