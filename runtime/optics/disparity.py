"""Disparity of a pair of pictures, compared with the range that a stack's gaps can show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8

WIDTH_PX = 256  # width of the raster on the middle panel that pictures are matched on
REACH_PX = WIDTH_PX // 4  # largest disparity searched, in either direction
# In units of the outer panels' disparity. High-contrast blocks have 35 dB of light (1 mm) at 2, 30 at 3 and 26 at 4,
# instead of 38.
SHOWN_MOST = 2.5
TOO_MUCH = 0.1  # least share of a picture beyond `SHOWN_MOST` that is reported
ROLLED, TURNED = 0.05, 0.2  # largest slopes of the line between the eyes for which picture rows correspond
LEAST_MATCHED = 0.1  # share of the panel that must be matched
LEAST_ONCE = 1 / 3  # share of the matches that must be the only ones at their place; else the picture repeats
WINDOW_PX, APART_PX = 21, 4  # of two matches at one place
NO_WORSE = 1.3, 1.0  # factor and codes: errors up to which the second match is as good


def disparities_m(pictures: Sequence[U8 | F32], eyes_m: F64, stack: PanelStack, *, fov_deg: float) -> F64:
    """(n,) disparities, metres on the middle panel, of points that match only once.

    Positive for points in front of that panel, which are farther right for the left eye. Pictures are `fov_deg` wide
    and look at the stack's origin. Empty if the line between the eyes is not level or not parallel to the panels, or
    if most of the pictures repeats.
    """
    line = eyes_m[1] - eyes_m[0]
    if line[1] <= 0 or abs(line[2]) > ROLLED * line[1] or abs(line[0]) > TURNED * line[1]:
        return np.empty(0)
    small = replace(stack, width_px=WIDTH_PX, height_px=max(16, round(WIDTH_PX * stack.height_m / stack.width_m)))
    panel, size = small.panel(stack.count // 2), (WIDTH_PX, small.height_px)
    found: list[Any] = []
    for picture, eye_m in zip(pictures, eyes_m, strict=True):
        height, width = picture.shape[:2]
        codes: Any = picture[..., :3] if picture.dtype == np.uint8 else np.rint(255 * picture[..., :3])
        image = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg)
        matrix = panel_from_image(image, panel)
        coarser = np.ascontiguousarray(codes, np.uint8)
        grey = cv2.warpPerspective(cv2.cvtColor(coarser, cv2.COLOR_RGB2GRAY), matrix, size, flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full((height, width), 255, np.uint8), matrix, size)
        found += [cv2.copyMakeBorder(one, 0, 0, REACH_PX, REACH_PX, cv2.BORDER_CONSTANT) for one in (grey, inside)]
    left, left_inside, right, _ = found
    matcher = cv2.StereoSGBM.create(
        minDisparity=-REACH_PX, numDisparities=2 * REACH_PX, blockSize=5, P1=200, P2=800, disp12MaxDiff=1,
        uniquenessRatio=10, speckleWindowSize=40, speckleRange=2,
    )  # fmt: skip
    matched = matcher.compute(left, right) / 16.0
    seen = (matched >= -REACH_PX) & (left_inside == 255)
    once = seen & ~_is_ambiguous(left, right, matched)
    if once.sum() < LEAST_ONCE * seen.sum():
        return np.empty(0)
    return np.asarray(matched[once] * panel.pitch_u_m, np.float64)


def _is_ambiguous(left: U8, right: U8, matched: F64) -> NDArray[np.bool_]:
    """Mask of places where another disparity matches as well, as in a texture that repeats.

    The matcher's own test compares ratios, and so misses matches without any error.
    """
    there = right.astype(np.float32)
    halves = (there + np.roll(there, 1, 1)) / 2, (there + np.roll(there, -1, 1)) / 2
    least, most = np.minimum(there, np.minimum(*halves)), np.maximum(there, np.maximum(*halves))
    found, other = np.full((2, *left.shape), np.inf, np.float32)
    for shift_px in range(-REACH_PX, REACH_PX + 1):
        low, high = np.roll(least, shift_px, 1), np.roll(most, shift_px, 1)
        error = np.maximum(0.0, np.maximum(left - high, low - left))  # Birchfield and Tomasi: half a pixel is free
        cost = cv2.blur(error, (WINDOW_PX, WINDOW_PX))
        away_px = np.abs(matched - shift_px)
        np.minimum(found, cost, out=found, where=away_px <= 1)
        np.minimum(other, cost, out=other, where=away_px > APART_PX)
    return np.asarray(other <= NO_WORSE[0] * found + NO_WORSE[1])


def disparity_doubts(
    pictures: Sequence[U8 | F32], eyes_m: F64, stack: PanelStack, *, fov_deg: float, parallel: bool = True
) -> list[str]:
    """Explain in one line why eyes (2, 3) will see ghosts of these pictures; empty if no reason is found.

    parallel: the pictures may be a rectified pair from parallel cameras, passed by mistake as the eyes' own views.
    """
    apart_m, away_m = float(eyes_m[1, 1] - eyes_m[0, 1]), float(eyes_m[:, 0].mean())
    centre_m = stack.x_m[stack.count // 2]
    rear_m, front_m = (apart_m * (x_m - centre_m) / (away_m - x_m) for x_m in (stack.x_m[0], stack.x_m[-1]))
    shown_m = SHOWN_MOST * (front_m - rear_m) / 2
    found_m = disparities_m(pictures, eyes_m, stack, fov_deg=fov_deg)
    if len(found_m) < LEAST_MATCHED * WIDTH_PX**2 * stack.height_m / stack.width_m:
        return []
    beyond = float(np.mean(np.abs(found_m) > shown_m))
    if beyond < TOO_MUCH:
        return []

    def place(disparity_m: float) -> str:
        if disparity_m <= -0.95 * apart_m:
            return "infinitely far behind"
        depth_mm = 1e3 * disparity_m * (away_m - centre_m) / (apart_m + disparity_m)
        return f"{abs(depth_mm):.0f} mm {'before' if depth_mm > 0 else 'behind'}"

    low_m, middle_m, high_m = (float(value) for value in np.percentile(found_m, (10, 50, 90)))
    told = f"pictures: {beyond:.0%} of them has more disparity than these gaps can show without ghosts. Things stand "
    told += f"{place(low_m)} to {place(high_m)} the middle panel; {place(-shown_m)} to {place(shown_m)} can be shown"
    if parallel and low_m > 0:
        width_m = 2 * np.hypot(away_m, eyes_m[:, 1:].mean(axis=0)).max() * np.tan(np.radians(fov_deg / 2))
        shift_px = middle_m / width_m * pictures[0].shape[1] / 2
        told += ". All of it is before that panel, as in a rectified pair (parallel cameras): give the cameras, or "
        told += f"move the left picture {shift_px:.0f} pixels to the left and the right one as far to the right"
    return [told]
