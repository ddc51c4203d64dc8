"""A camera's pictures of real faces at known places: NASA's Eileen Collins (scikit-image ships her portrait), and the
US Navy's Grace Hopper (matplotlib ships hers)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from skimage.data import astronaut

from runtime.records import F64, U8, Intrinsics, SensorFrame

IPD_M = 0.062


@dataclass(frozen=True)
class Portrait:
    """A picture, cut to the head, and the pupils in it, read off by eye: the viewer's left one first."""

    picture: U8
    pupils: F64


@cache
def eileen() -> Portrait:
    return Portrait(astronaut()[20:230, 120:330], np.array([[247.5, 103.2], [203.7, 101.2]]) - [120, 20])


@cache
def grace() -> Portrait:
    path = Path(mpl.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    picture = np.asarray(cv2.imread(str(path)), np.uint8)[..., ::-1]
    return Portrait(
        np.ascontiguousarray(picture[40:400, 90:430]), np.array([[305.0, 186.5], [222.8, 190.0]]) - [90, 40]
    )


def camera(width_px: int = 1920, height_px: int = 1080, fov_deg: float = 70.0) -> Intrinsics:
    return Intrinsics.centred(width_px, height_px, fov_rad=np.radians(fov_deg))


def scene(
    *viewers: F64,
    intrinsics: Intrinsics,
    portraits: tuple[Portrait, ...] = (),
    wall_m: float = 2.5,
    depth_size: tuple[int, int] | None = None,
    noise: float = 0.0,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, list[F64]]:
    """Colour, depth (mm), and each viewer's true eyes (2, 3), the farthest first.

    viewers: (3,) middle between the eyes, frame `sensor`; portraits: theirs, else Eileen's; noise: of colour, codes.
    """
    i = intrinsics
    colour = np.full((i.height_px, i.width_px, 3), 120, np.uint8)
    depth = np.full((i.height_px, i.width_px), round(wall_m * 1000), np.uint16)
    truth = []
    shown = zip(viewers, portraits or (eileen(),) * len(viewers), strict=True)
    for middle, portrait in sorted(shown, key=lambda one: -one[0][2]):
        pupils, picture = portrait.pupils, portrait.picture
        scale = i.fx_px * IPD_M / middle[2] / np.linalg.norm(pupils[0] - pupils[1])
        centre = np.array([middle[0] / middle[2] * i.fx_px + i.cx_px, middle[1] / middle[2] * i.fy_px + i.cy_px])
        offset = centre - pupils.mean(0) * scale
        affine = np.array([[scale, 0, offset[0] + scale / 2 - 0.5], [0, scale, offset[1] + scale / 2 - 0.5]])
        size = (i.width_px, i.height_px)
        if scale < 0.87:
            picture = cv2.GaussianBlur(picture, (0, 0), 0.45 * np.sqrt(1 / scale**2 - 1))
        face = cv2.warpAffine(picture, affine, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpAffine(np.ones(picture.shape[:2], np.uint8), affine, size, flags=cv2.INTER_NEAREST) > 0
        colour[inside] = face[inside]
        depth[inside] = round(middle[2] * 1000)
        pixels = pupils * scale + offset
        truth.append(np.column_stack([(pixels - [i.cx_px, i.cy_px]) / [i.fx_px, i.fy_px] * middle[2], [middle[2]] * 2]))
    if depth_size is not None:
        depth = cv2.resize(depth, depth_size, interpolation=cv2.INTER_NEAREST)
    if noise:
        noisy = colour + np.random.default_rng(seed).normal(0, noise, colour.shape)
        colour = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return colour, depth, truth


def frame(colour: np.ndarray, depth: np.ndarray | None, intrinsics: Intrinsics, *, number: int = 1) -> SensorFrame:
    return SensorFrame(number, number * 33_333_333, colour=colour, depth_mm=depth, intrinsics=intrinsics)
