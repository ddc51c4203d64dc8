"""Crosstalk between the eyes, luminance uniformity and viewing freedom, on ideal panels.

Crosstalk is L_dark / L_bright (the black level is 0): one eye should see a white patch, the other eye black (Woods, J.
Electron. Imaging 21 (2012) 040902). Standards measure it with patches that fill the display (IEC 62629-22-1; IDMS).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from runtime.model.predictor import Predictor
from runtime.model.still import solve_still
from runtime.optics.carried import expected_errors
from runtime.optics.light import LIGHT
from runtime.optics.quality import psnr_db
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64, U8, Eyes
from runtime.report.pairs import PairPainter, StillPair, eyes_at
from runtime.report.tolerance import falls_at, solved

WIDTH_PX = 960  # crosstalk is measured on panels with at most this many columns
PATCHES_MM = (2.0, 4.0, 6.0, 10.0, 20.0, 40.0, 80.0)
DISPARITIES_MM = (2.0, 4.0, 8.0, 16.0, 32.0)
WIDE_MM = 60.0  # width of the patch that has a disparity
INNER = 0.6  # share of a region's width and height that is measured
MOVES_MM = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
NEAR_M = 0.02  # least distance between the viewer and the front panel
FALL_DB = 3.0  # the picture counts as good as far as light falls by less than this
FOV_DEG = 40.0
Rectangle = tuple[float, float, float, float]  # left, right, bottom, top in metres on the plane x = 0


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """Crosstalk of a patch."""

    patch_mm: float  # width and height, or the display's width if it fills the display
    percent: float
    theory_percent: float | None  # None unless the stack has three evenly spaced panels
    disparity_mm: float | None = None  # shift between the eyes' patches on the plane x = 0; None: one eye sees no patch


def reduced(stack: PanelStack) -> PanelStack:
    """Return the stack with fewer pixels, if it has more than crosstalk needs."""
    return stack.reduced(max(1, math.ceil(stack.width_px / WIDTH_PX)))


def parallax_m(stack: PanelStack, eyes_m: Eyes) -> float:
    """Return an outer panel's parallax for each eye on the middle plane (docs/mathematics.md)."""
    middle = eyes_m.mean(axis=0)
    gap_m = (stack.x_m[-1] - stack.x_m[0]) / 2
    return float(np.linalg.norm(eyes_m[1] - eyes_m[0]) / 2 * gap_m / middle[0])


def theory_percent(width_m: float, parallax: float) -> float:
    """Return a patch's least crosstalk on three panels, in percent (docs/mathematics.md)."""
    difference = min(1.0, 4 * parallax / width_m)
    return 100 * (1 - math.sin(math.pi / 2 * difference)) / (1 + math.sin(math.pi / 2 * difference))


class Patches:
    """Solves for patches that the two eyes see differently."""

    def __init__(self, stack: PanelStack, eyes_m: Eyes, predictor: Predictor) -> None:
        """Prepare to measure with `predictor`, which must have been loaded for the same stack."""
        self.stack, self.eyes_m, self._predictor = stack, eyes_m, predictor
        self._is_regular = stack.count == 3 and stack.is_evenly_spaced

    def sizes(self) -> Iterator[Crosstalk]:
        """Measure patches of all sizes, white for the left eye and black for the right eye."""
        whole_mm = self.stack.width_m * 1e3
        for size_mm in (*[size for size in PATCHES_MM if size < self.stack.height_m * 1e3], whole_mm):
            half = size_mm / 2e3
            patch = (-half, half, -half, half)
            yield self._measure(size_mm, (patch, None), (patch, patch), size_mm, None)

    def disparities(self) -> Iterator[Crosstalk]:
        """Measure a white patch on black that both eyes see, with more and more disparity between them."""
        half = min(WIDE_MM / 2e3, self.stack.height_m / 4)
        for disparity_mm in DISPARITIES_MM:
            shift = disparity_mm / 2e3
            left, right = (-half - shift, half - shift, -half, half), (-half + shift, half + shift, -half, half)
            only_left = (-half - shift, -half + shift, -half, half)
            only_right = (half - shift, half + shift, -half, half)
            yield self._measure(disparity_mm, (left, right), (only_left, only_right), 2e3 * half, disparity_mm)

    def _measure(
        self,
        differs_mm: float,
        shown: tuple[Rectangle | None, Rectangle | None],
        regions: tuple[Rectangle, Rectangle],
        patch_mm: float,
        disparity_mm: float | None,
    ) -> Crosstalk:
        pictures = [self._picture(eye, patch) for eye, patch in zip(self.eyes_m, shown, strict=True)]
        left, right = pictures
        layers = solve_still(
            left, right, eyes_m=self.eyes_m, fov_deg=FOV_DEG, predictor=self._predictor, eye_sigma_mm=1.0
        ).layers
        bright = self._mean(0, layers, regions[0])
        dark = self._mean(1, layers, regions[0])
        if shown[1] is not None:
            bright = (bright + self._mean(1, layers, regions[1])) / 2
            dark = (dark + self._mean(0, layers, regions[1])) / 2
        theory = theory_percent(differs_mm / 1e3, parallax_m(self.stack, self.eyes_m)) if self._is_regular else None
        return Crosstalk(patch_mm, 100 * dark / max(bright, 1e-6), theory, disparity_mm)

    def _corners(self, eye_m: F64, patch: Rectangle) -> F64:
        """Return a rectangle's corners in an eye's picture, (4, 2) pixels."""
        left, right, bottom, top = patch
        points = np.array([[0, y, z, 1] for y, z in ((left, top), (right, top), (right, bottom), (left, bottom))])
        size = {"width_px": self.stack.width_px, "height_px": self.stack.height_px}
        seen = points @ image_from_stack(eye_m, **size, fov_deg=FOV_DEG).T
        return np.asarray(seen[:, :2] / seen[:, 2:])

    def _picture(self, eye_m: F64, patch: Rectangle | None) -> U8:
        picture = np.zeros((self.stack.height_px, self.stack.width_px, 3), np.uint8)
        if patch is not None:
            corners = np.rint((self._corners(eye_m, patch) - 0.5) * 256).astype(np.int32)
            cv2.fillConvexPoly(picture, corners, (255, 255, 255), cv2.LINE_AA, 8)
        return picture

    def _mean(self, side: int, layers: U8, region: Rectangle) -> float:
        """Return an eye's view, averaged over the inner part of a region."""
        left, right, bottom, top = region
        y, z = (left + right) / 2, (bottom + top) / 2
        half = (right - left) / 2 * INNER, (top - bottom) / 2 * INNER
        inner = self._corners(self.eyes_m[side], (y - half[0], y + half[0], z - half[1], z + half[1]))
        seen = seen_by(self.eyes_m[side], layers, self.stack, fov_deg=FOV_DEG)
        mask = np.zeros(seen.mask.shape, np.uint8)
        cv2.fillConvexPoly(mask, np.rint((inner - 0.5) * 256).astype(np.int32), 1, cv2.LINE_8, 8)
        chosen = (mask > 0) & seen.mask
        return float(seen.image[chosen].mean())


def uniformity(falloff: float) -> float:
    """Return the lowest of nine points' luminances, divided by the highest. The points are at 10, 50 and
    90 % of the width and the height. Luminance falls with the square of the distance from the middle, by `falloff` in
    the corners (`Lighting`).
    """
    lights = [1 - falloff * 2 * (y * y + z * z) for y in (-0.4, 0.0, 0.4) for z in (-0.4, 0.0, 0.4)]
    return min(lights) / max(lights)


def freedom_without_tracking(pair: StillPair, layers: U8) -> dict[str, Any]:
    """Measure light while the head moves but the layers stay. For each direction: lists `mm` and
    `light_db`, and `falls_3_db_at_mm`, or None if it does not fall as far.
    """
    height, width = pair.images[0].shape[:2]
    sampling = LIGHT._replace(step=max(1, math.ceil(math.sqrt(height * width / 20_000))))

    def light(move_m: Sequence[float]) -> float:
        moved = pair.eyes_m + np.array(move_m)
        at: Any = {"eyes_m": pair.eyes_m, "seen_from_m": moved, "fov_deg": pair.fov_deg, "sigmas_mm": (0.0,)}
        return psnr_db(float(expected_errors(layers, pair.images, pair.stack, sampling=sampling, **at)[0.0][0]))

    result = {}
    for name, axis in (("to the right", (0, 1, 0)), ("up", (0, 0, 1)), ("away", (1, 0, 0))):
        moves = (0.0, *MOVES_MM)
        lights = [light([mm / 1e3 * part for part in axis]) for mm in moves]
        costs = [lights[0] - light_db for light_db in lights]
        result[name] = {"mm": moves, "light_db": lights, "falls_3_db_at_mm": falls_at(moves, costs, FALL_DB)}
    return result


PLACES = ((0.4, 0.0), (0.6, 0.0), (0.9, 0.0), (1.2, 0.0), (0.6, 20.0), (0.6, 40.0))  # distance in m, angle in degrees


def freedom_with_tracking(stack: PanelStack, scene: str) -> Iterator[dict[str, float]]:
    """Yield `distance_m`, `angle_deg` and the `light_db` of layers that are solved for each of `PLACES`."""
    with PairPainter(scene, reduced(stack)) as painter:
        for distance_m, angle_deg in PLACES:
            eyes_m = eyes_at(distance_m=distance_m, angle_deg=angle_deg, height_m=0.03)
            if eyes_m[:, 0].min() > stack.x_m[-1] + NEAR_M:
                light_db = psnr_db(solved(painter.pair("", eyes_m, off_mm=())).ideal_error)
                yield {"distance_m": distance_m, "angle_deg": angle_deg, "light_db": light_db}
