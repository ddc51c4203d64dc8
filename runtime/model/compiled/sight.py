"""What a picture's own rays see of three layers, and what they lack, back on a panel's raster."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from runtime.model.compiled.pixels import locate, sample_pixels
from runtime.model.compiled.sampling import CHANNELS, OPTIONS, PASS, U
from runtime.records import F64, I16, U8
from runtime.support.threads import on_rows

PARTS = 16  # of a code: what is lacked is told in these


@njit(**OPTIONS)
def _spread(within, count, weights):  # pragma: no cover
    for k in range(count):
        at = U(k) * U(CHANNELS)
        for channel in range(CHANNELS - 1):
            weights[at + U(channel)] = within[U(k)]
        weights[at + U(CHANNELS - 1)] = np.float32(0)


@njit(**PASS)
def lack_of_rays(
    rear,
    centre,
    front,
    width,
    height,
    matrices,
    least,
    most,
    picture,
    out,
    first,
    last,
    places,
    shares,
    within,
    sums,
    weights,
):  # pragma: no cover
    """Rows first to last of what a picture (rows, numbers) uint8 has and an eye does not see, into out (rows, numbers)
    int16, `PARTS` of a code: what is beyond `least` codes, up to `most`; 0 in the fourth channel and for rays that
    don't cross every layer.

    rear, centre, front: layers (numbers,) uint8, `width` times `height` pixels. matrices (3, 3, 3): their pixels from
    the picture's, pixel centres at integers, of a positive weight before the eye. places (2, pixels), shares
    (2, pixels), within (pixels,), sums, weights (numbers,): to work in.
    """
    count = picture.shape[1] // CHANNELS
    half_turns, parts, none = np.float32(1 / (2 * 255)), np.float32(PARTS), np.float32(0)
    let_be, limit = np.float32(least), np.float32(most)
    for row in range(first, last):
        for k in range(count):
            within[U(k)] = parts
        for k in range(count * CHANNELS):
            sums[U(k)] = none
        for n in range(3):
            locate(matrices[n], row, 0, count, width, height, places[0], places[1], shares[0], shares[1], within)
            if n == 0:
                sample_pixels(rear, places[0], places[1], shares[0], shares[1], count, sums)
            elif n == 1:
                sample_pixels(centre, places[0], places[1], shares[0], shares[1], count, sums)
            else:
                sample_pixels(front, places[0], places[1], shares[0], shares[1], count, sums)
        line = U(row)
        for k in range(count * CHANNELS):  # sin² of what the layers add up to, by Taylor's series
            turns = sums[U(k)] * half_turns
            x = (turns - np.floor(turns + np.float32(0.5))) * np.float32(np.pi)
            y = x * x
            series = np.float32(1 / 362880) * y - np.float32(1 / 5040)
            series = ((series * y + np.float32(1 / 120)) * y - np.float32(1 / 6)) * y + np.float32(1)
            sine = series * x
            lack = np.float32(picture[line, U(k)]) - np.float32(255) * sine * sine
            sums[U(k)] = min(max(lack - min(max(lack, -let_be), let_be), -limit), limit)
        _spread(within, count, weights)
        for k in range(count * CHANNELS):
            out[line, U(k)] = np.int16(np.int32(np.floor(sums[U(k)] * weights[U(k)] + np.float32(0.5))))


@njit(**PASS)
def add_lack(
    lack, width, height, matrix, gain, image, u0, pixels, first, last, places, shares, within, sums, weights
):  # pragma: no cover
    """image (rows, numbers) uint8 plus `gain` times what is lacked there, rows first to last, `pixels` from u0 on.

    lack: (numbers,) int16, `width` times `height` pixels, `PARTS` of a code. matrix (3, 3): its
    pixels from the image's.
    """
    scale, none, half, most = np.float32(gain / PARTS), np.float32(0), np.float32(0.5), np.float32(255)
    for row in range(first, last):
        for k in range(pixels):
            within[U(k)] = scale
        for k in range(pixels * CHANNELS):
            sums[U(k)] = none
        locate(matrix, row, u0, pixels, width, height, places[0], places[1], shares[0], shares[1], within)
        sample_pixels(lack, places[0], places[1], shares[0], shares[1], pixels, sums)
        line, begin = U(row), U(u0) * U(CHANNELS)
        _spread(within, pixels, weights)
        for k in range(pixels * CHANNELS):
            code = np.float32(image[line, begin + U(k)]) + sums[U(k)] * weights[U(k)] + half
            image[line, begin + U(k)] = np.uint8(np.int32(min(max(code, none), most)))


def lack_at_rays(layers: U8, picture: U8, matrices: F64, *, least: float, most: float) -> I16:
    """(h, w, 4) what a picture (h, w, 4) has and an eye does not see of layers (3, H, W, 4), `PARTS` of a code: what
    is beyond `least` codes, up to `most`.

    matrices: (3, 3, 3) the layers' pixels from the picture's, pixel centres at integers. 0 for rays that don't cross
    every layer half a pixel inside its edge.
    """
    height, width = layers.shape[1:3]
    flat = [np.ascontiguousarray(layer).reshape(-1) for layer in layers]
    numbers = np.ascontiguousarray(picture).reshape(picture.shape[0], -1)
    out: I16 = np.empty(numbers.shape, np.int16)

    def share(first: int, last: int) -> None:
        lack_of_rays(*flat, width, height, matrices, least, most, numbers, out, first, last, *_work(picture.shape[1]))

    on_rows(share, 0, picture.shape[0])
    return out.reshape(picture.shape)


def add_at_raster(image: U8, lack: I16, matrix: F64, *, gain: float, rows: slice, columns: slice) -> None:
    """Rows and columns of an image (h, w, 4), plus `gain` times what is lacked there (rows, columns, 4), linearly.

    matrix: 3x3, the pixels of `lack` from the image's, pixel centres at integers.
    """
    height, width = lack.shape[:2]
    numbers, pixels = image.reshape(image.shape[0], -1), columns.stop - columns.start
    place = matrix, gain, numbers, columns.start, pixels

    def share(first: int, last: int) -> None:
        add_lack(lack.reshape(-1), width, height, *place, first, last, *_work(pixels))

    on_rows(share, rows.start, rows.stop)


def _work(pixels: int) -> tuple[Any, ...]:
    return (
        np.zeros((2, pixels), np.int32),
        np.zeros((2, pixels), np.float32),
        np.zeros(pixels, np.float32),
        np.zeros(pixels * CHANNELS, np.float32),
        np.zeros(pixels * CHANNELS, np.float32),
    )
