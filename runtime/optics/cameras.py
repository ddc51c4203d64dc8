"""Resample pictures from arbitrary cameras to the views of eyes that look at the stack's origin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.retina import ImageRays
from runtime.optics.rpu import panel_from_image
from runtime.optics.sampling import projected
from runtime.optics.stack import PanelStack, between_pixel_centres
from runtime.optics.views import stack_from_eye
from runtime.records import F32, F64, U8, Eyes

OUTSIDE_MOST = 1 / 3  # warn if more than this share of a picture is outside the panels
LEAST_PX = 16  # minimum width and height of a resampled picture
EXACT = 1e-6  # cameras count as equal if their matrices differ by less than this times the picture's width
DIGITS = 9  # decimals kept in metres and degrees; rounding recovers the values that a camera matrix was built from
NAMES = ("left", "right")
Picture = U8 | F32  # (h, w, 3)


def as_cameras(matrices: Any, *, count: int = 2) -> tuple[F64, F64]:
    """Return the (V, 3, 4) projections and (V, 3) positions of cameras, given their 3x4 matrices from
    metres in `stack` to pixels. Signs are chosen so that the third homogeneous coordinate is positive in front of the
    camera. Raises ValueError if a matrix is not finite or its left 3x3 part has no inverse.
    """
    try:
        cameras = np.asarray(matrices, np.float64)
    except (TypeError, ValueError):
        cameras = np.empty(0)
    if cameras.shape != (count, 3, 4) or not np.isfinite(cameras).all():
        told = "two 3x4 matrices (left and right)" if count == 2 else f"{count} 3x4 matrices"
        raise ValueError(f"must be {told} that map metres in the stack frame to pixels")
    turns = np.linalg.det(cameras[:, :, :3])
    if not (np.abs(turns) > 0).all():
        raise ValueError("must be matrices whose left 3x3 block is invertible")
    cameras = cameras * np.sign(turns)[:, None, None]  # positive third coordinate in front of the camera
    places_m = -np.linalg.solve(cameras[:, :, :3], cameras[:, :, 3:])[..., 0]
    return cameras, np.asarray(np.round(places_m, DIGITS), np.float64)


def looking_at_origin(
    pictures: Sequence[Picture], cameras: F64, eyes_m: Eyes, stack: PanelStack
) -> tuple[list[Picture], float]:
    """Resample pictures as if their cameras had been aimed at the stack's origin; return them and their
    fov_deg. The new pictures cover as much of the panels as all originals allow, and are sampled bicubically. Aimed
    pictures are returned unchanged. Raises ValueError if a picture does not show the stack's centre.
    """
    height, width = pictures[0].shape[:2]
    turns = [np.diag([1.0, -1.0, -1.0]) @ stack_from_eye(eye_m)[:3, :3].T for eye_m in eyes_m]
    # These matrices map directions (x, y, 1), relative to a gaze at the origin, to picture pixels.
    pixels_from_gaze = [camera[:, :3] @ turn.T for camera, turn in zip(cameras, turns, strict=True)]
    for n, matrix in enumerate(pixels_from_gaze):
        if not _within(matrix, np.zeros(2), width, height):
            name = NAMES[n] if len(pixels_from_gaze) == 2 else f"{n + 1}."
            raise ValueError(f"the {name} picture does not show the centre of the stack; aim the camera at it")
    pixels_from_gaze = [matrix / matrix[2, 2] for matrix in pixels_from_gaze]
    focal_px = pixels_from_gaze[0][0, 0]
    centred = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    if all(np.abs(matrix - centred).max() < EXACT * width for matrix in pixels_from_gaze):
        return list(pictures), round(2 * math.degrees(math.atan(width / 2 / focal_px)), DIGITS)
    corners_m = np.array([(x, y, z) for x in stack.x_m for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    corners_m *= (1.0, stack.width_m, stack.height_m)
    extent = np.zeros(2)
    for turn, eye_m in zip(turns, eyes_m, strict=True):
        seen = (corners_m - eye_m) @ turn.T
        extent = np.maximum(extent, np.abs(seen[:, :2] / seen[:, 2:]).max(0))

    def shown(share: F64) -> bool:
        return all(_within(matrix, share * extent, width, height) for matrix in pixels_from_gaze)

    both = _most(lambda share: shown(np.array([share, share])))
    share = np.array([both, both])
    share[0] = _most(lambda wider: shown(np.array([wider, share[1]])), least=both)
    share[1] = _most(lambda higher: shown(np.array([share[0], higher])), least=both)
    half = share * extent
    focal_px = max(math.sqrt(abs(np.linalg.det(_slope(matrix)))) for matrix in pixels_from_gaze)
    size = [max(LEAST_PX, round(2 * focal_px * side)) for side in half]
    focal_px = size[0] / 2 / half[0]
    direction = np.array([[1, 0, -size[0] / 2], [0, 1, -size[1] / 2], [0, 0, focal_px]]) / focal_px
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    turned: list[Picture] = []
    for picture, matrix in zip(pictures, pixels_from_gaze, strict=True):
        warped: Any = cv2.warpPerspective(
            picture, between_pixel_centres(matrix @ direction), size, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        turned.append(warped if warped.dtype == np.uint8 else np.clip(warped, 0, 1))
    return turned, 2 * math.degrees(math.atan(half[0]))


def _within(matrix: F64, half: F64, width: int, height: int) -> bool:
    """Return True if `matrix` maps all directions (x, y, 1) with |x| <= half[0], |y| <= half[1] into a picture."""
    corners = np.array([(x * half[0], y * half[1], 1.0) for x in (-1, 1) for y in (-1, 1)]) @ matrix.T
    if not (corners[:, 2] > 0).all():
        return False
    pixels = corners[:, :2] / corners[:, 2:]
    return bool((pixels >= 0).all() and (pixels <= (width, height)).all())


def _most(holds: Any, least: float = 0.0) -> float:
    """Return the largest number between `least` and 1 that satisfies the monotonic condition `holds`."""
    most = 1.0
    if holds(most):
        return most
    for _ in range(30):
        middle = (least + most) / 2
        least, most = (middle, most) if holds(middle) else (least, middle)
    return least


def _slope(matrix: F64) -> F64:
    """Return the (2, 2) derivative of pixel coordinates with respect to direction at (0, 0, 1)."""
    return np.asarray(matrix[:2, :2] - np.outer(matrix[:2, 2], matrix[2, :2]))


def doubts(eyes_m: ArrayLike, stack: PanelStack, *, fov_deg: float, size: tuple[int, int]) -> list[str]:
    """Return a one-line warning for each likely mistake in `eyes_m` or `fov_deg`."""
    eyes, warnings = np.asarray(eyes_m, np.float64), []
    if fov_deg <= math.pi:
        warnings.append(
            f"fov_deg: {fov_deg:g} degrees looks like radians; did you mean {math.degrees(fov_deg):.1f} degrees?"
        )
    pairs = [eyes[n : n + 2] for n in range(0, len(eyes) - 1, 2)]
    if any((right - left) @ stack_from_eye((left + right) / 2)[:3, 0] < 0 for left, right in pairs):
        warnings.append("eyes_m: the left eye is to the right of the right eye; swap the eyes if this is not intended")
    width_px, height_px = 64, max(2, round(64 * size[1] / size[0]))
    shares = []
    for eye in eyes:
        rays = ImageRays.of_eye(eye, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
        middle_from_image = panel_from_image(rays.image_from_stack, stack.panel(stack.count // 2))
        u, v, _ = projected(middle_from_image, rays.u, rays.v)
        inside = rays.toward_panels() & (u > 0) & (u < stack.width_px) & (v > 0) & (v < stack.height_px)
        shares.append(float(inside.mean()))
    if 1 - min(shares) > OUTSIDE_MOST:
        warnings.append(
            f"fov_deg: {1 - min(shares):.0%} of a picture that is {fov_deg:g} degrees wide and aimed at the stack's "
            "origin is outside the panels; if the camera was aimed elsewhere, pass its matrix"
        )
    return warnings
