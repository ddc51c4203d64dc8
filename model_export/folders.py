"""Training pairs from folders of the official data set's naming (`pair0_x.._y.._z.._{0,1}.jpg`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path

import cv2
import numpy as np

from model_export.data import CENTRE, TrainingPair
from model_export.eyereal import PICTURE_FOV_DEG
from model_export.scene import shift
from runtime.content.eyereal import Pair, read_folder
from runtime.content.presets import preset
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster
from runtime.records import U8
from runtime.support import untrusted_input
from runtime.support.artifacts import read_image

PANELS = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)


def folder_pairs(folders: Sequence[Path], *, scene: str, width_px: int, height_px: int) -> list[TrainingPair]:
    """Every pair of some folders, on the panels of a scene's preset at a raster. They have no views from elsewhere.

    Raises InputError: a folder without pairs, half a pair, a picture that can't be read or fits no other.
    """
    if not folders:
        return []
    chosen = preset(scene, "published-code")
    stack = chosen.stack(PanelStack(PANELS.width_m, PANELS.height_m, PANELS.x_m, width_px, height_px))
    result = []
    for folder in folders:
        if not untrusted_input.is_there(folder, folder=True):
            raise InputError(folder, "", "is not a folder")
        result += [_loaded(pair, stack) for pair in read_folder(folder, chosen)]
    return result


def _loaded(pair: Pair, stack: PanelStack) -> TrainingPair:
    pictures = [read_image(path) for path in pair.paths]
    if pictures[0].shape != pictures[1].shape:
        raise InputError(pair.paths[1], "size", f"differs from {pair.paths[0].name}")
    left, right = (
        on_centre(picture, pair, side, stack, fov_deg=PICTURE_FOV_DEG) for side, picture in enumerate(pictures)
    )
    return TrainingPair(stack, pair.eyes_m, (left, right), 0.0)


def on_centre(picture: U8, pair: Pair, side: int, stack: PanelStack, *, fov_deg: float) -> U8:
    """(h, w, 3) what an eye of a pair, whose picture this is, sees through the centre panel's pixels.

    Averaged where they are fewer.
    """
    height, width = picture.shape[:2]
    raster = stack.panel(CENTRE)
    factor = max(1, round(width / raster.width_px))
    smaller = cv2.resize(picture, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    height, width = smaller.shape[:2]
    projection = pair.image_from_stack(side, width_px=width, height_px=height, fov_deg=fov_deg)
    matrix = shift(-0.5, -0.5) @ image_from_raster(projection, raster) @ shift(0.5, 0.5)
    warped = cv2.warpPerspective(
        smaller,
        matrix,
        (raster.width_px, raster.height_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(warped, np.uint8)


def mixed(
    procedural: Iterator[TrainingPair], pairs: Sequence[TrainingPair], *, first: int = 0
) -> Iterator[TrainingPair]:
    """Pairs of folders and procedural ones in turn; procedural alone where there are no others.

    first: which of the folders' pairs, in their endless row, is the first.
    """
    if not pairs:
        yield from procedural
    begun = islice(cycle(pairs), first % max(len(pairs), 1), None)
    for pair, own in zip(procedural, begun, strict=False):
        yield pair
        yield own
