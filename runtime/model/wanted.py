"""The phase sums that the eyes' pictures ask for, on rasters of the centre panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2

from runtime.model.channels import without_alpha
from runtime.model.transfer import pre_emphasised
from runtime.optics.rect import PixelRect
from runtime.records import I16, U8
from runtime.support.threads import at_once


@dataclass(frozen=True, slots=True)
class Pictures:
    """What is asked for: both eyes' pictures within a box of the centre panel."""

    arrays: Sequence[U8]  # (h, w, 4) of the whole panel, left and right
    box: PixelRect
    channels: int  # 1 or 3
    emphasis: float  # how strongly they are sharpened (`transfer.pre_emphasised`)
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
