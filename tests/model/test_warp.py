"""The compiled sampler, by `warp`: bilinear samples, as numpy has them."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.model.chain import ColumnLaw
from runtime.model.geometry import TargetView
from runtime.model.warp import picture_on, reduced_view, resized_px, source_px, warp
from runtime.optics.stack import PlaneRaster
from runtime.records import F64, I16

OUTSIDE = -1
TOLERANCE = 2.5  # of elements up to 4080: two mixtures, rounded, with weights of 14 bits that grow from pixel to pixel


def bilinear(
    image: NDArray[Any], image_from_result: F64, size: tuple[int, int], *, near_px: float = 0.0
) -> tuple[F64, NDArray[Any]]:
    """Samples (rows, columns, C), an image's edge going on, and which lie in it, so far from its edges."""
    v, u = np.mgrid[: size[0], : size[1]] + 0.5
    x, y, w = np.einsum("ij,jhw->ihw", image_from_result, np.stack([u, v, np.ones_like(u)]))
    height, width = image.shape[:2]
    x, y = x / w, y / w
    within = (w > 0) & (x >= near_px) & (x <= width - near_px) & (y >= near_px) & (y <= height - near_px)
    x, y = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    to_right, down = (x - left)[..., None], (y - top)[..., None]
    upper, lower = (
        (1 - to_right) * image[row, left] + to_right * image[row, left + 1].astype(np.float64) for row in (top, top + 1)
    )
    return (1 - down) * upper + down * lower, within


def scaled(scale: float, size: tuple[int, int], *, shift_px: float = 0.3) -> F64:
    """About a picture's middle."""
    height, width = size
    middle = [width / 2 * (1 - scale) + shift_px, height / 2 * (1 - min(scale, 2)) + 0.2]
    return np.array([[scale, 0, middle[0]], [0, min(scale, 2), middle[1]], [0, 0, 1.0]])


@pytest.mark.parametrize("size", [(8, 64), (90, 777)])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("scale", [0.02, 0.4, 0.91, 1.0, 1.0625, 1.1, 1.6, 2.5, 5.0, 37.0])
def test_any_scale(size: tuple[int, int], channels: int, scale: float) -> None:
    image = np.random.default_rng(0).integers(0, 4081, (*size, channels)).astype(np.int16)
    matrix = scaled(scale, size)
    expected, within = bilinear(image, matrix, size)
    found = warp(image[..., 0] if channels == 1 else image, matrix, size=size, outside=OUTSIDE, reach_px=0.0)
    off = np.abs(found.reshape(expected.shape) - expected)[within]
    assert off.size
    assert off.max() < TOLERANCE


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (7.0, 0.0), (-5.0, 3.0), (3.0, 0.5)])
def test_pixels_on_pixels_are_the_images_own(shift_px: tuple[float, float]) -> None:
    image = np.random.default_rng(1).integers(0, 4081, (40, 333, 3)).astype(np.int16)
    matrix = np.array([[1.0, 0, shift_px[0]], [0, 1.0, shift_px[1]], [0, 0, 1.0]])
    expected, within = bilinear(image, matrix, (40, 333))
    found = warp(image, matrix, size=(40, 333), outside=OUTSIDE, reach_px=0.0)
    assert np.abs(found - expected)[within].max() <= (0.5 if shift_px[1] % 1 else 0)
    assert (found[~within] == OUTSIDE).all()


@pytest.mark.parametrize("turn", [-9e-4, 1e-5, 3e-4, 9e-4])
def test_perspective_along_rows(turn: float) -> None:
    """Smooth, since places are exact to some thousandths of a pixel."""
    rows, columns = np.mgrid[:90, :777]
    image = np.repeat((2040 + 1500 * np.sin(columns / 5) * np.cos(rows / 7))[..., None], 3, axis=2).astype(np.int16)
    matrix = np.array([[0.9, 0.01, 20], [0.004, 0.95, 2], [turn, 0, 1.0 - 388 * turn]])
    expected, within = bilinear(image, matrix, (90, 777), near_px=1.0)
    found = warp(image, matrix, size=(90, 777), outside=OUTSIDE, reach_px=0.0)
    assert np.abs(found - expected)[within].max() < 4


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("bent", ["neither", "image", "result"])
def test_images_may_be_turned_and_flipped(turns: int, flipped: bool, bent: str) -> None:
    """With columns that are spaced by a logarithm in one of both rasters."""
    rows, columns = np.mgrid[:80, :90]
    image = (2040 + 900 * np.sin(columns / 7) + 900 * np.cos(rows / 9)).astype(np.int16)
    (c, s), law = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns], ColumnLaw(4e-3, 40.0)
    turn = 0.7 * np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if flipped else 1.0, 1.0]) + [[0.02, -0.03], [0.01, 0.04]]
    matrix = np.array([[*turn[0], 45 - turn[0] @ (40, 30)], [*turn[1], 40 - turn[1] @ (40, 30)], [6e-4, -9e-4, 1.003]])
    laws = {} if bent == "neither" else {f"{bent}_columns": law}
    for channels in (1, 3):
        given = image if channels == 1 else image[..., None].repeat(3, 2)
        found = warp(given, matrix, size=(60, 80), outside=OUTSIDE, **laws)
        v, u = np.mgrid[:60, :80] + 0.5
        t = law.homography_from_column(u) if bent == "result" else u
        x, y, w = (matrix[k, 0] * t + matrix[k, 1] * v + matrix[k, 2] for k in range(3))
        x, y = x / w, y / w
        x = law.middle - np.log(1 - law.bend * (x - law.middle)) / law.bend if bent == "image" else x
        wanted = 2040 + 900 * np.sin((x - 0.5) / 7) + 900 * np.cos((y - 0.5) / 9)
        inner = (x > 1) & (x < 89) & (y > 1) & (y < 79)
        assert found.shape == (60, 80, *given.shape[2:]) and inner.mean() > 0.9
        assert (
            np.abs(found.reshape(60, 80, channels) - wanted[..., None])[inner].max() < 20
        )  # an eighth of a pixel on the steepest slope


@pytest.mark.parametrize("bent", ["neither", "image", "result"])
def test_mirrored_columns_are_sampled_in_the_same_time(bent: str) -> None:
    size = (540, 960)
    image = np.random.default_rng(2).integers(0, 4081, (*size, 3)).astype(np.int16)
    law = ColumnLaw(2e-4, 400.0)
    laws = {} if bent == "neither" else {f"{bent}_columns": law}
    mirrored_laws = {"image_columns": law.mirrored(size[1])} if bent == "image" else laws
    forwards = np.array([[0.9, 0.3, 40.0], [0.1, 0.9, 5.0], [0.0, 0.0, 1.0]])
    backwards = np.array([[-1.0, 0.0, size[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ forwards

    def warped(matrix: F64, source: NDArray[np.int16], **laws: ColumnLaw) -> tuple[I16, float]:
        seconds = []
        for _ in range(5):
            begun = perf_counter()
            found = warp(source, matrix, size=size, outside=OUTSIDE, threads=1, **laws)
            seconds.append(perf_counter() - begun)
        return found, min(seconds)

    expected, seconds = warped(forwards, image, **laws)
    found, mirrored_s = warped(backwards, np.ascontiguousarray(image[:, ::-1]), **mirrored_laws)
    assert np.abs(found - expected).max() <= 1
    assert mirrored_s < 3 * seconds


def test_a_pixel_spans_as_many_source_pixels_as_at_the_middle() -> None:
    assert source_px(np.diag([2.0, 3.0, 1.0]), (200, 100)) == (2.0, 3.0)
    leaning = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1e-3, 0.0, 1.0]])  # at u = 100, the weight is 1.1
    assert source_px(leaning, (200, 100)) == pytest.approx((np.hypot(1 / 1.21, 0.05 / 1.21), 1 / 1.1))


@pytest.mark.parametrize(
    ("pixels", "scale", "resized"),
    [(100, 2.0, 50), (100, 0.5, 200), (100, 0.25, 400), (100, 0.1, 400), (100, 50.0, 16), (10, 50.0, 10)],
)
def test_pictures_are_resized_within_limits(pixels: int, scale: float, resized: int) -> None:
    assert resized_px(pixels, scale) == resized


RASTER = PlaneRaster(0.0, -0.032, 0.024, 1e-3, 1e-3, 64, 48)


@pytest.mark.parametrize(
    ("reduction", "times", "size", "shrunk"),
    [
        (1, 1, (49, 66), (1, 1)),
        (2, 1, (49, 66), (2, 2)),
        (2, 2, (98, 132), (4, 4)),
        (4, 1, (49, 66), (3, 4)),  # each side keeps 16 pixels
        (9, 1, (20, 200), (1, 9)),
    ],
)
def test_pictures_are_averaged_to_pixels_of_the_reduced_panel(
    reduction: int, times: int, size: tuple[int, int], shrunk: tuple[int, int]
) -> None:
    picture = np.random.default_rng(3).integers(0, 256, (*size, 3)).astype(np.uint8)
    view = TargetView(picture, RASTER.plane_from_raster() @ np.diag([1 / times, 1 / times, 1.0]))
    found, (by_v, by_u) = reduced_view(view, RASTER, reduction), shrunk
    assert found.pixels.shape == (size[0] // by_v, size[1] // by_u, 3)
    assert np.abs(found.pixels[1, 2] - picture[by_v : 2 * by_v, 2 * by_u : 3 * by_u].mean(axis=(0, 1))).max() <= 0.5
    assert found.plane_from_picture @ (2, 1, 1) == pytest.approx(view.plane_from_picture @ (2 * by_u, by_v, 1))


def test_a_picture_on_the_raster_is_not_resampled() -> None:
    picture = np.random.default_rng(3).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    how: Any = {"edge": 1, "size": (48, 64)}
    for shift_px, same in ((1e-7, True), (1e-5, False), (1.0, False)):
        moved = np.array([[1.0, 0.0, shift_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        view = TargetView(picture, 5 * RASTER.plane_from_raster())
        found = picture_on(view, RASTER, middle_from_result=moved, **how)
        assert (found is picture) == same and (found[:, 3] == picture[:, 3 + round(shift_px)]).all()
    coarse = picture_on(view, RASTER, middle_from_result=np.diag([2.0, 2.0, 1.0]), edge=1, size=(24, 32))
    assert np.abs(coarse[5, 7] - picture[10:12, 14:16].mean(axis=(0, 1))).max() <= 1
