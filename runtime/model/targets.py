"""What pictures ask of the panels: 8-bit codes to phase sums in fixed point, by tables; grey ones in one channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.optics.malus import Branch, phase_from_intensity
from runtime.optics.rect import PixelRect
from runtime.records import I16, U8
from runtime.support.threads import at_once

SUBCODE = 16  # fixed point: sixteenths of an 8-bit panel code
FULL = 255 * SUBCODE  # one panel's whole range, a quarter turn
SLOPE_FLOOR = 0.25  # the least weight of a ray beside the slope of sin² where it is wanted
COARSE_STEP = 16  # a look at every so many pixels tells most coloured pictures for next to nothing


@lru_cache(maxsize=4)
def phase_codes(branch: Branch = 2) -> NDArray[np.int16]:
    """(256,) phase sum, in sixteenths of a panel code, for each 8-bit code value an eye should see."""
    codes = np.arange(256) / 255.0
    return np.rint(phase_from_intensity(codes, branch) * FULL).astype(np.int16)


def pre_emphasised(picture: U8, strength: float) -> U8:
    """Sharpened by what interpolation will blur: on the way to the panels' pixels, and between them in the eye.

    A separable [-a, 1 + 2a, -a] on every channel; 0 leaves the picture as it is.
    """
    if not strength:
        return picture
    kernel = np.array([-strength, 1 + 2 * strength, -strength], np.float32)
    return np.asarray(cv2.sepFilter2D(picture, -1, kernel, kernel), np.uint8)


def is_grey(picture: U8) -> bool:
    """True where red, green and blue are equal in every pixel of an (h, w, 4) picture: no colour may be lost."""
    coarse = picture[::COARSE_STEP, ::COARSE_STEP]
    if (coarse[..., 0] != coarse[..., 1]).any() or (coarse[..., 1] != coarse[..., 2]).any():
        return False
    red, green, blue, _ = cv2.split(picture)
    return cv2.norm(red, green, cv2.NORM_INF) == 0.0 and cv2.norm(green, blue, cv2.NORM_INF) == 0.0


def without_alpha(picture: U8, channels: int) -> U8:
    """The (h, w, 4) picture as (h, w, 3), or as (h, w) where it is grey and one channel will do."""
    if channels == 1:
        return np.asarray(cv2.extractChannel(picture, 0), np.uint8)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB), np.uint8)


@dataclass(frozen=True, slots=True)
class Pictures:
    """What is asked for: both eyes' pictures within a box of the centre panel."""

    arrays: Sequence[U8]  # (h, w, 4) of the whole panel, left and right
    box: PixelRect
    channels: int  # 1 or 3
    emphasis: float  # how strongly they are sharpened (`pre_emphasised`)
    table: I16  # (256,) what is asked for each code: its phase sum


def fill_targets(pictures: Pictures, pairs: Sequence[Sequence[I16]]) -> None:
    """Phase sums at the size of pairs of images (h, w[, 3]), left and right, averaged as codes: into them."""

    def sharpened(picture: U8) -> U8:
        return pre_emphasised(without_alpha(picture[pictures.box.slices], pictures.channels), pictures.emphasis)

    def fill(item: tuple[U8, I16]) -> None:
        picture, image = item
        size = image.shape[1::-1]
        same = picture.shape[1::-1] == size
        cv2.LUT(picture if same else cv2.resize(picture, size, interpolation=cv2.INTER_AREA), pictures.table, dst=image)

    sharp = at_once(sharpened, pictures.arrays)
    for pair in pairs:
        at_once(fill, list(zip(sharp, pair, strict=True)))
