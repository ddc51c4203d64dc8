"""A camera's pictures of a real face (NASA's portrait of Eileen Collins, which scikit-image ships) at a known place."""

from __future__ import annotations

import cv2
import numpy as np
from skimage.data import astronaut

from runtime.records import F64, Intrinsics, SensorFrame

# The pupils in the 512 x 512 portrait, read off by eye: the viewer's left (on the right), then the right.
PUPILS_PX = np.array([[247.5, 103.2], [203.7, 101.2]])
IPD_M = 0.062


def camera(width_px: int = 1920, height_px: int = 1080, fov_deg: float = 70.0) -> Intrinsics:
    focal = width_px / 2 / np.tan(np.radians(fov_deg) / 2)
    return Intrinsics(width_px, height_px, focal, focal, width_px / 2, height_px / 2)


def scene(
    *viewers: F64, intrinsics: Intrinsics, wall_m: float = 2.5, depth_size: tuple[int, int] | None = None
) -> tuple[np.ndarray, np.ndarray, list[F64]]:
    """Colour, depth (mm), and each viewer's true eyes (2, 3). viewers: (3,) middle between the eyes, frame `sensor`."""
    i = intrinsics
    colour = np.full((i.height_px, i.width_px, 3), 120, np.uint8)
    depth = np.full((i.height_px, i.width_px), round(wall_m * 1000), np.uint16)
    portrait = astronaut()[20:230, 120:330]
    pupils = PUPILS_PX - np.array([120, 20])
    truth = []
    for middle in sorted(viewers, key=lambda place: -place[2]):
        scale = i.fx_px * IPD_M / middle[2] / np.linalg.norm(pupils[0] - pupils[1])
        centre = np.array([middle[0] / middle[2] * i.fx_px + i.cx_px, middle[1] / middle[2] * i.fy_px + i.cy_px])
        offset = centre - pupils.mean(0) * scale
        affine = np.array([[scale, 0, offset[0] + scale / 2 - 0.5], [0, scale, offset[1] + scale / 2 - 0.5]])
        size = (i.width_px, i.height_px)
        face = cv2.warpAffine(portrait, affine, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpAffine(np.ones(portrait.shape[:2], np.uint8), affine, size, flags=cv2.INTER_NEAREST) > 0
        colour[inside] = face[inside]
        depth[inside] = round(middle[2] * 1000)
        pixels = pupils * scale + offset
        truth.append(np.column_stack([(pixels - [i.cx_px, i.cy_px]) / [i.fx_px, i.fy_px] * middle[2], [middle[2]] * 2]))
    if depth_size is not None:
        depth = cv2.resize(depth, depth_size, interpolation=cv2.INTER_NEAREST)
    return colour, depth, truth


def frame(colour: np.ndarray, depth: np.ndarray, intrinsics: Intrinsics, *, number: int = 1) -> SensorFrame:
    return SensorFrame(number, number * 33_333_333, colour=colour, depth_mm=depth, intrinsics=intrinsics)
