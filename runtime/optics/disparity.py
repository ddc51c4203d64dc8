"""Compare the disparity between two pictures with the largest disparity that a stack can show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8, Eyes

WIDTH_PX = 256  # width of the middle-panel raster used to compare the pictures
REACH_PX = WIDTH_PX // 4  # largest disparity searched, in either direction
# Ghosts up to this size (root mean square, relative to full scale) are not reported. The example pair's other errors
# are about as large (37 dB of light), so larger ghosts would cost more than 3 dB.
GHOSTS_MOST = 0.015
BEYOND_LEAST = 0.1  # minimum share of matches outside the stack; content inside the stack causes no ghosts
LARGER, MOST_LARGER = 1.1, 20.0  # ratio of one gap tried to the one before; largest gap tried, relative to the stack's
ROLLED, TURNED = 0.05, 0.2  # steepest slopes of the line between the eyes for picture rows to correspond
LEAST_MATCHED = 0.1  # minimum share of the panel that must have a match
LEAST_ONCE = 1 / 3  # minimum share of matches that must be unambiguous; otherwise the picture is repetitive
WINDOW_PX, APART_PX = 21, 4  # side of the cost window; minimum distance between two matches of a pixel
NO_WORSE = 1.3, 1.0  # a match is ambiguous if another error is at most 1.3 times the smallest error, plus 1 code


@dataclass(frozen=True, slots=True)
class _Compared:
    """Left and right pictures, resampled to a coarse middle-panel raster for comparison."""

    grey: tuple[U8, U8]  # (h, w) each
    inside: tuple[U8, U8]  # 255 where the picture covers the panel
    panel: PlaneRaster

    def ghosts(self, unit_m: float) -> float:
        """Estimate the RMS light that reaches the wrong eye because panel values are limited, relative to
        full scale.

        The two eyes' rays through a point on the front panel cross the middle panel `unit_m` apart; through a point on
        the rear panel, the same distance apart in reverse order. The difference between the eyes' pictures is therefore
        `unit_m` times the slope of (front - rear), which is limited to [-1, 1]. Where the integral along a row would
        leave this range, the difference is lost, and both eyes see the mean.
        """
        light = np.stack(self.grey) / 255.0
        value = np.arcsin(np.sqrt(light)) / (np.pi / 2)
        both = (self.inside[0] == 255) & (self.inside[1] == 255)
        step = np.where(both, value[0] - value[1], 0.0) * (self.panel.pitch_u_m / unit_m)
        low, high = np.percentile(np.cumsum(step, axis=1), (5, 95), axis=1)
        at, lost = -(low + high) / 2, np.zeros_like(step)
        for column, wanted in enumerate(step.T):
            lost[:, column] = at + wanted
            at = np.clip(lost[:, column], -1.0, 1.0)
            lost[:, column] -= at
        share = np.divide(lost, step, out=np.zeros_like(step), where=step != 0).clip(0.0, 1.0)
        return float(np.sqrt(np.mean((share * (light[0] - light[1]) / 2)[both] ** 2))) if both.any() else 0.0

    def disparities_m(self) -> F64:
        """Return the (n,) disparities of unambiguously matched points, in metres on the middle panel,
        positive in front of it. The result is empty if most of the picture is repetitive or too few points match.
        """
        sides = 0, 0, REACH_PX, REACH_PX
        framed: list[Any] = [
            cv2.copyMakeBorder(one, *sides, cv2.BORDER_CONSTANT) for one in (*self.grey, self.inside[0])
        ]
        left, right, inside = framed
        matcher = cv2.StereoSGBM.create(
            minDisparity=-REACH_PX, numDisparities=2 * REACH_PX, blockSize=5, P1=200, P2=800, disp12MaxDiff=1,
            uniquenessRatio=10, speckleWindowSize=40, speckleRange=2,
        )  # fmt: skip
        matched: Any = matcher.compute(left, right) / 16.0
        seen = (matched >= -REACH_PX) & (inside == 255)
        once = seen & ~_is_ambiguous(left, right, matched)
        if once.sum() < max(LEAST_ONCE * seen.sum(), LEAST_MATCHED * self.grey[0].size):
            return np.empty(0)
        return np.asarray(matched[once] * self.panel.pitch_u_m, np.float64)


def _compared(pictures: Sequence[U8 | F32], eyes_m: Eyes, stack: PanelStack, *, fov_deg: float) -> _Compared:
    """Resample left and right picture, from cameras aimed at the stack's origin, to a coarse middle-panel raster."""
    small = replace(stack, width_px=WIDTH_PX, height_px=max(16, round(WIDTH_PX * stack.height_m / stack.width_m)))
    panel, size = small.panel(stack.count // 2), (WIDTH_PX, small.height_px)
    framed: list[Any] = []
    for picture, eye_m in zip(pictures, eyes_m, strict=True):
        codes: Any = picture[..., :3] if picture.dtype == np.uint8 else np.rint(255 * picture[..., :3])
        grey = cv2.cvtColor(np.ascontiguousarray(codes, np.uint8), cv2.COLOR_RGB2GRAY)
        # If the pictures were not shrunk first, fine textures would differ between the eyes at random.
        shrunk = min(1.0, WIDTH_PX / stack.width_m * _width_m(eye_m, fov_deg) / grey.shape[1])
        grey = cv2.resize(grey, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
        height, width = grey.shape
        matrix = panel_from_image(image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg), panel)
        framed += [cv2.warpPerspective(one, matrix, size) for one in (grey, np.full_like(grey, 255))]
    return _Compared((framed[0], framed[2]), (framed[1], framed[3]), panel)


def _width_m(eye_m: F64, fov_deg: float) -> float:
    """Return the width, in metres, covered by an eye's picture at the distance of the stack's origin."""
    return float(2 * np.linalg.norm(eye_m) * np.tan(np.radians(fov_deg / 2)))


def _is_ambiguous(left: U8, right: U8, matched: F64) -> NDArray[np.bool_]:
    """Return a mask of the pixels where another disparity fits almost as well as `matched` (h, w), as in repetitive
    textures. The matcher's own uniqueness test compares error ratios, so it fails if the smallest error is 0.
    """
    there = right.astype(np.float32)
    halves = (there + np.roll(there, 1, 1)) / 2, (there + np.roll(there, -1, 1)) / 2
    least, most = np.minimum(there, np.minimum(*halves)), np.maximum(there, np.maximum(*halves))
    best, other = np.full((2, *left.shape), np.inf, np.float32)
    for shift_px in range(-REACH_PX, REACH_PX + 1):
        low, high = np.roll(least, shift_px, 1), np.roll(most, shift_px, 1)
        # Birchfield and Tomasi's error, which tolerates a shift of half a pixel.
        error = np.maximum(0.0, np.maximum(left - high, low - left))
        cost = cv2.blur(error, (WINDOW_PX, WINDOW_PX))
        away_px = np.abs(matched - shift_px)
        np.minimum(best, cost, out=best, where=away_px <= 1)
        np.minimum(other, cost, out=other, where=away_px > APART_PX)
    return np.asarray(other <= NO_WORSE[0] * best + NO_WORSE[1])


def disparity_doubts(
    pictures: Sequence[U8 | F32], eyes_m: Eyes, stack: PanelStack, *, fov_deg: float, parallel: bool
) -> list[str]:
    """Return a one-line warning, in a list, if the pictures will cause ghosts, or an empty list.
    `parallel`: they may be a rectified pair from parallel cameras, passed by mistake; the warning says so if it seems
    so.
    """
    line = eyes_m[1] - eyes_m[0]
    if line[1] <= 0 or abs(line[2]) > ROLLED * line[1] or abs(line[0]) > TURNED * line[1]:
        return []  # a point may appear in different rows in the two pictures
    compared = _compared(pictures, eyes_m, stack, fov_deg=fov_deg)
    apart_m, away_m = float(line[1]), float(eyes_m[:, 0].mean())
    centre_m = stack.x_m[stack.count // 2]
    rear_m, front_m = (apart_m * (x_m - centre_m) / (away_m - x_m) for x_m in (stack.x_m[0], stack.x_m[-1]))
    unit_m = (front_m - rear_m) / 2
    ghosts = compared.ghosts(unit_m)
    if ghosts <= GHOSTS_MOST:
        return []
    found_m = compared.disparities_m()
    if not len(found_m) or np.mean(np.abs(found_m) > unit_m) < BEYOND_LEAST:
        return []

    def place(disparity_m: float) -> str:
        if disparity_m <= -0.95 * apart_m:
            return "infinitely far behind"
        depth_mm = 1e3 * disparity_m * (away_m - centre_m) / (apart_m + disparity_m)
        return f"{abs(depth_mm):.0f} mm {'in front of' if depth_mm > 0 else 'behind'}"

    low_m, middle_m, high_m = (float(value) for value in np.percentile(found_m, (10, 50, 90)))
    warning = "pictures: the disparity is too large for the panels' gaps and will cause ghosts, estimated at "
    warning += f"{ghosts:.0%} of full scale. The scene is {place(low_m)} to {place(high_m)} the middle panel"
    factors = LARGER ** np.arange(1, 1 + np.log(MOST_LARGER) / np.log(LARGER))
    if larger := next((float(one) for one in factors if compared.ghosts(one * unit_m) <= GHOSTS_MOST), None):
        warning += f"; to avoid ghosts, increase the gaps by a factor of {larger:.1f} or divide the disparity by it"
    if parallel and low_m > 0:
        shift_px = middle_m / _width_m(eyes_m.mean(axis=0), fov_deg) * pictures[0].shape[1] / 2
        warning += ". The whole scene is in front of that panel, as in a rectified pair from parallel cameras; pass "
        warning += (
            f"the cameras, or shift the left picture {shift_px:.0f} pixels left and the right picture right by as much"
        )
    return [warning]
