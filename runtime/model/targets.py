"""Tables that convert a picture's 8-bit codes to target sums of panel values in fixed point."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from runtime.kernels import FULL, SUBCODE
from runtime.optics.malus import Branch, phase_from_intensity, rest_code, rest_value
from runtime.optics.stack import PanelStack
from runtime.records import F32, I16, U8

SLOPE_FLOOR = 0.25  # minimum weight of a ray; at the steepest slope of sin², the weight is 1
COARSE_STEP = 16  # sample spacing in pixels for a quick test that recognises most coloured pictures


def rest_of(panels: int) -> int:
    """Return a panel's rest value in sixteenths of a code."""
    return round(rest_value(panels) * FULL)


def slope_of(panels: int) -> int:
    """Return which slope of sin² contains the sums of panel values: 1 falls (1 to 2), 2 rises (2 to 3)."""
    return int(rest_value(panels) * panels)


@lru_cache(maxsize=8)
def target_table(panels: int) -> F32:
    """Return the (256, 2) target sums of panel values, in sixteenths of a code, and weights, by the code
    to be seen. Of all the sums that show a code, the target is the one nearest to the panels' rest values. The weight
    depends on the slope of sin² at the target and is 1 where the slope is steepest.
    """
    intensities = np.arange(256) / 255.0
    slope = slope_of(panels)
    rise = 2 / np.pi * np.arcsin(np.sqrt(intensities))
    sums = slope + (1 - rise if slope % 2 else rise)
    share = rise * (1 - rise) * 4
    return np.stack([sums * FULL, SLOPE_FLOOR + (1 - SLOPE_FLOOR) * share], axis=1).astype(np.float32)


@lru_cache(maxsize=8)
def middle_codes(panels: int) -> U8:
    """Return, for each of 256 codes, the middle-panel code that shows it if the other panels are at rest."""
    codes = (target_table(panels)[:, 0] - (panels - 1) * rest_of(panels)) / SUBCODE
    return np.clip(np.rint(codes), 0, 255).astype(np.uint8)


def outside_codes(panels: int, n: int, outside: int | tuple[int, ...]) -> list[int]:
    """Return panel `n`'s RGB code outside the window, given the middle panel's or the colour seen."""
    if n != panels // 2:
        return [rest_code(panels)] * 3
    return middle_codes(panels)[list(outside)].tolist() if isinstance(outside, tuple) else [outside] * 3


@lru_cache(maxsize=4)
def phase_codes(branch: Branch) -> I16:
    """Return the (256,) sums of panel values, in sixteenths of a code, for each code to be seen."""
    codes = np.arange(256) / 255.0
    return np.rint(phase_from_intensity(codes, branch) * FULL).astype(np.int16)


def is_grey(picture: U8) -> bool:
    """Return True if red, green and blue are equal at every pixel of an (h, w, 3 or 4) picture."""
    coarse = picture[::COARSE_STEP, ::COARSE_STEP]
    if (coarse[..., 0] != coarse[..., 1]).any() or (coarse[..., 1] != coarse[..., 2]).any():
        return False
    red, green, blue = cv2.split(picture)[:3]
    return cv2.norm(red, green, cv2.NORM_INF) == 0.0 and cv2.norm(green, blue, cv2.NORM_INF) == 0.0


def without_alpha(picture: U8, channels: int) -> U8:
    """Return an (h, w, 3) picture or, if `channels` is 1, its first channel (h, w)."""
    if channels == 1:
        return np.asarray(cv2.extractChannel(picture, 0), np.uint8)
    return picture if picture.shape[2] == 3 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB), np.uint8)


def flat_layers(image: U8, stack: PanelStack) -> U8:
    """Return (N, h, w, 4) layers that show the same (h, w, 4) picture to every eye."""
    middle = stack.count // 2
    layers = np.full((stack.count, stack.height_px, stack.width_px, 4), 255, np.uint8)
    # The other panels add up to the sum where the slope begins, and the middle panel adds the picture.
    even = slope_of(stack.count) * 255 // (stack.count - 1)
    layers[..., :3] = even
    sums = np.rint(target_table(stack.count)[:, 0] / SUBCODE)
    codes = np.clip(sums - even * (stack.count - 1), 0, 255).astype(np.uint8)
    rest = cv2.LUT(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), codes)
    layers[middle, ..., :3] = rest
    return layers
