"""The three panels on one raster, whole or coarser: what corrections of the outer two read and write.

Phases are fixed-point (sixteenths of an 8-bit code), so that OpenCV and numpy do the work on 16-bit integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Protocol

import cv2
import numpy as np

from runtime.model.chain import EVEN_COLUMNS, ColumnLaw
from runtime.model.channels import RGBA_FROM
from runtime.model.contract import LEAST_SPREAD_PX
from runtime.model.resample import buffer, resample, target_from_source
from runtime.model.rows import RowPool, Work
from runtime.model.transfer import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen, layer_pixels_from_seen
from runtime.records import F32, F64, I16, U8

REAR, CENTRE, FRONT = 0, 1, 2
OUTER = (REAR, FRONT)
EYES = (0, 1)
START = FULL // 2  # of every outer panel: the middle of its range
MOST_SPREAD = 8.0  # pixels
MOST = 32767  # what 16 bits hold
WHOLE_WEIGHT = 1 << 14  # of weights that are held in 16 bits
NEUTRAL = (START + SUBCODE // 2) // SUBCODE  # the same in 8-bit codes, rounded as what is shown is


class Fading(Protocol):
    """How a residual ends towards the edges of a part of larger panels (`fade.Softening`)."""

    @property
    def columns(self) -> F32:
        """(columns,) weights, 0 to 1."""

    @property
    def rows(self) -> F32:
        """(rows,) the same."""

    def soften(self, residual: Sequence[I16]) -> None:
        """Weaken it, in place: (rows, columns[, 3]) for each eye."""


class PyramidLevel:
    """Buffers for one stack at `1 / reduction` of its columns and rows; state lives from frame to frame.

    Images are (h, w, 3), or (h, w) where there is one channel.
    """

    def __init__(self, stack: PanelStack, *, reduction: int, rows: RowPool, channels: int = 3) -> None:
        self.reduction = reduction
        self._stack = stack
        self._rows = rows
        self._channels = channels
        self._tail = () if channels == 1 else (channels,)
        height, width = -(-stack.height_px // reduction), -(-stack.width_px // reduction)
        names = [*(("outer", n, 0) for n in OUTER), *(("seen", n, side) for n in OUTER for side in EYES)]
        names += [(name, CENTRE, side) for name in ("wanted", "residual", "back") for side in EYES]
        self._whole = {name: buffer(height, width, channels=channels) for name in names}
        self.rasters: tuple[PlaneRaster, ...] = ()
        self.spread: dict[int, tuple[float, float]] = {}  # per outer panel, right and down, pixels
        self.slope_floor = 1.0  # the least weight of a ray; 1: all weigh alike (`_slope`)
        self._mean: dict[int, I16] = {}

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the centre panel's raster."""
        return self.rasters[CENTRE].width_px, self.rasters[CENTRE].height_px

    def crop(self, boxes: Sequence[PixelRect], stack: PanelStack) -> None:
        """Cut every raster and buffer to what the eyes look through."""
        self._stack = stack
        self.rasters = tuple(coarser(box.cut(stack.panel(n)), self.reduction) for n, box in enumerate(boxes))
        self.outer = {n: self._view("outer", n, 0, on=n) for n in OUTER}
        self.seen = {(n, side): self._view("seen", n, side, on=CENTRE) for n in OUTER for side in EYES}
        self.target = tuple(self._view("wanted", CENTRE, side, on=CENTRE) for side in EYES)  # phase sums
        self.residual = tuple(self._view("residual", CENTRE, side, on=CENTRE) for side in EYES)
        self._back = {n: tuple(self._view("back", CENTRE, side, on=n) for side in EYES) for n in OUTER}

    def set_eye_sigma(self, eyes_m: F64, *, eye_sigma_mm: float, least_px: float = LEAST_SPREAD_PX) -> None:
        """Correct for eyes (2, 3) that err by so much, an axis: what is left of the outer panels in the mean counts,
        and what moves of them is noise. Spreads too small to be felt on this raster are none."""
        self.spread = spreads(self.rasters, eyes_m, eye_sigma_mm=eye_sigma_mm, least_px=least_px)

    def project(self, panels: Sequence[int], eyes_m: F64) -> None:
        """See outer panels anew through the centre panel's pixels: in the mean, where the eyes are unsure."""
        for n in panels:
            panel = self._blurred(self.outer[n], n)
            self._mean[n] = panel
            for side, eye_m in enumerate(eyes_m):
                self._between(panel, eye_m, of=n, on=CENTRE, out=self.seen[n, side])

    def step(self, panel: int, eyes_m: F64, *, size: float, shown: bool, fading: Fading | None = None) -> None:
        """Change one outer panel by what both eyes (2, 3) still lack; fading: how the residual ends towards edges."""
        self.update_residuals()
        if fading is not None:
            fading.soften(self.residual)
        self.correct(panel, eyes_m, size=size, shown=shown)

    def update_residuals(self) -> None:
        """Find what each eye still lacks when the centre panel is the best one for the outer panels."""
        seen, residual, wanted = self.seen, self.residual, self.target

        def work(rows: slice, best: I16) -> None:
            for side in EYES:
                np.subtract(wanted[side][rows], seen[REAR, side][rows], out=residual[side][rows])
                np.subtract(residual[side][rows], seen[FRONT, side][rows], out=residual[side][rows])
            left, right = residual[0][rows], residual[1][rows]
            if self.slope_floor < 1:
                slopes = [self._slope(image[rows]) for image in wanted]
                middle = _weighed_best((left, right), slopes)
                for image, slope in zip((left, right), slopes, strict=True):
                    image[...] = np.rint(slope * (image - middle))
                return
            np.add(left, right, out=best)
            np.right_shift(best, 1, out=best)
            np.clip(best, 0, FULL, out=best)
            np.subtract(left, best, out=left)
            np.subtract(right, best, out=right)

        self._each(CENTRE, work)

    def correct(self, panel: int, eyes_m: F64, *, size: float, shown: bool) -> None:
        """Change one outer panel by what both eyes lack along the rays through each of its pixels."""
        back, outer = self._back[panel], self.outer[panel]
        other = REAR if panel == FRONT else FRONT
        slopes = [self._slope(image) for image in self.target] if self.slope_floor < 1 else None
        for side, eye_m in enumerate(eyes_m):
            residual = self.residual[side]
            if self.spread:
                # With m of a wave left, the noise is |front - m²·rear|²(1 - m²): its gradient joins the mean's.
                seen = self.seen[other, side]
                moving = seen - self._blurred(seen, panel, twice=True)
                if slopes is not None:
                    moving = np.rint(slopes[side] * moving).astype(np.int16)
                residual = residual + moving
            self._between(residual, eye_m, of=CENTRE, on=panel, out=back[side])
        if slopes is not None:
            self._divide_by_weights(panel, eyes_m, slopes)
        if self.spread:
            noise = outer - self._blurred(self._mean[panel], panel)
            back[0][...] = self._blurred(back[0] + back[1], panel) - 2 * noise
            back[1][...] = 0
        eighths = np.int16(round(size * 8))

        def work(rows: slice, change: I16) -> None:
            if slopes is not None:
                change[...] = np.clip(np.rint(back[0][rows] * np.float32(eighths / 8)), -FULL, FULL)
            else:
                np.add(back[0][rows], back[1][rows], out=change)
                np.right_shift(change, 3, out=change)
                np.multiply(change, eighths, out=change)
            np.add(change, outer[rows], out=change)
            _clamp_and_quantise(change, outer[rows], shown=shown)

        self._each(panel, work)

    def _divide_by_weights(self, panel: int, eyes_m: F64, slopes: Sequence[F32]) -> None:
        """Of what comes back to an outer panel, by the mean weight of the two rays through each of its pixels."""
        back = self._back[panel]
        total: F32 = np.zeros(back[0].shape, np.float32)
        for eye_m, slope in zip(eyes_m, slopes, strict=True):
            held = np.rint(slope * WHOLE_WEIGHT).astype(np.int16)
            there = buffer(*back[0].shape[:2], channels=self._channels)
            self._between(held, eye_m, of=CENTRE, on=panel, out=there, outside=WHOLE_WEIGHT)
            total += there
        lacked = (back[0].astype(np.float32) + back[1]) * (2 * WHOLE_WEIGHT) / total
        back[0][...] = np.clip(np.rint(lacked), -MOST, MOST)
        back[1][...] = 0

    def _slope(self, wanted: I16) -> F32:
        """The weight of rays by the phase sums that are wanted of them: `slope_floor` to 1.

        An eye sees sin² of the phase: before white and black that is level, so that errors there are not seen.
        """
        part = wanted.astype(np.float32) / FULL
        part -= np.floor(part)
        return np.asarray(self.slope_floor + (1 - self.slope_floor) * 4 * part * (1 - part), np.float32)

    def set_panel(
        self, panel: int, codes: I16, codes_from_raster: F64, *, columns: ColumnLaw = EVEN_COLUMNS, shown: bool
    ) -> None:
        """An outer panel as it was drawn on a raster of its own, with columns by a law."""
        outer = self.outer[panel]
        resample(
            codes, image_from_result=codes_from_raster, out=outer, outside=START, cubic=True, image_columns=columns
        )
        self._each(panel, lambda rows, _: _clamp_and_quantise(outer[rows], outer[rows], shown=shown))

    def upsample(self, coarser: PyramidLevel, *, shown: bool) -> None:
        """Take the outer panels over from a coarser raster of the same boxes."""
        for n in OUTER:
            outer = self.outer[n]
            cv2.resize(coarser.outer[n], outer.shape[1::-1], dst=outer, interpolation=cv2.INTER_CUBIC)

            def work(rows: slice, _: I16, outer: I16 = outer) -> None:
                _clamp_and_quantise(outer[rows], outer[rows], shown=shown)

            self._each(n, work)

    def close_centre(self, out: U8) -> None:
        """The best centre panel for the outer ones, per pixel and in closed form, in 8-bit codes."""
        seen, wanted = self.seen, self.target

        def work(rows: slice, best: I16) -> None:
            if self.slope_floor < 1:
                lacks = [wanted[side][rows] - seen[REAR, side][rows] - seen[FRONT, side][rows] for side in EYES]
                middle = _weighed_best(lacks, [self._slope(image[rows]) for image in wanted])
                out[rows] = np.floor(middle / SUBCODE + 0.5)
                return
            np.add(wanted[0][rows], wanted[1][rows], out=best)
            for part in seen.values():
                np.subtract(best, part[rows], out=best)
            np.add(best, SUBCODE, out=best)
            np.right_shift(best, 5, out=best)
            np.clip(best, 0, 255, out=best)
            out[rows] = best

        self._each(CENTRE, work)

    def show(self, layers: U8, boxes: Sequence[PixelRect]) -> None:
        """All panels in 8-bit codes, the centre closed, into layers (N, H, W, 4), each within its box."""
        for n, box in enumerate(boxes):
            codes = np.empty((box.height_px, box.width_px, *self._tail), np.uint8)
            if n == CENTRE:
                self.close_centre(codes)
            else:
                cv2.convertScaleAbs(self.outer[n], dst=codes, alpha=1 / SUBCODE)
            layers[n][box.slices] = cv2.cvtColor(codes, RGBA_FROM[self._channels])

    def show_panels(self, panels: I16, layers: U8, boxes: Sequence[PixelRect]) -> None:
        """Panels (3, rows, numbers) in 8-bit codes, into layers (N, H, W, 4), each within its box."""
        for numbers, layer, box in zip(panels, layers, boxes, strict=True):
            part = numbers[: box.height_px, : box.width_px * self._channels].reshape(box.height_px, -1, *self._tail)
            codes = np.ascontiguousarray((part + SUBCODE // 2) // SUBCODE).astype(np.uint8)
            layer[box.slices] = cv2.cvtColor(codes, RGBA_FROM[self._channels])

    def _blurred(self, image: I16, panel: int, *, twice: bool = False) -> I16:
        """What is left of an image in the mean over where the eyes may be, as an outer panel's pixels move."""
        spread = self.spread.get(panel)
        if spread is None:
            return image
        u, v = (s * np.sqrt(2.0) if twice else s for s in spread)
        size = 2 * ceil(3 * max(u, v)) + 1
        return np.asarray(cv2.GaussianBlur(image, (size, size), sigmaX=u, sigmaY=v, borderType=cv2.BORDER_REPLICATE))

    def _each(self, panel: int, work: Work) -> None:
        raster = self.rasters[panel]
        self._rows.each((raster.height_px, raster.width_px, *self._tail), work)

    def _view(self, name: str, n: int, side: int, *, on: int) -> I16:
        """The first rows and columns of a buffer, with margins of its own."""
        parent = self._whole[name, n, side].base
        assert isinstance(parent, np.ndarray)
        return parent[: self.rasters[on].height_px, : self.rasters[on].width_px]

    def _between(self, image: I16, eye_m: F64, *, of: int, on: int, out: I16, outside: int | None = None) -> I16:
        """Panel `of`'s pixels on panel `on`'s raster, as an eye sees them in line. outside: what is beside them."""
        if outside is None:
            outside = 0 if of == CENTRE else START
        matrix = reprojection(self._stack, self.rasters, eye_m, of=of, on=on)
        return resample(image, image_from_result=matrix, out=out, outside=outside)


def reprojection(stack: PanelStack, rasters: Sequence[PlaneRaster], eye_m: F64, *, of: int, on: int) -> F64:
    """3x3, last entry 1: panel `of`'s pixels from panel `on`'s, as an eye (3,) sees them in line; one is the centre.

    A scale and a shift, but where panels are tilted (`optics.tilt`).
    """
    source, target = rasters[on], rasters[of]
    matrix = target_from_source(eye_m, source=source, target=target)
    if stack.tilt is not None:
        if of == CENTRE:
            back: F64 = np.linalg.inv(coarse_layer_from_seen(stack, on, eye_m)).astype(np.float64)
            matrix = matrix @ layer_pixels_from_seen(source, back)
        else:
            matrix = layer_pixels_from_seen(target, coarse_layer_from_seen(stack, of, eye_m)) @ matrix
        matrix /= matrix[2, 2]
    return matrix


def spreads(
    rasters: Sequence[PlaneRaster], eyes_m: F64, *, eye_sigma_mm: float, least_px: float
) -> dict[int, tuple[float, float]]:
    """Per outer panel whose pixels move by enough to be felt for eyes (2, 3) that err by so much: right and down."""
    eye_x_m, centre_x_m = eyes_m[:, 0].mean(), rasters[CENTRE].x_m
    found = {}
    for n in OUTER:
        raster = rasters[n]
        moved_m = eye_sigma_mm / 1e3 * abs(raster.x_m - centre_x_m) / (eye_x_m - centre_x_m)
        spread = min(moved_m / raster.pitch_u_m, MOST_SPREAD), min(moved_m / raster.pitch_v_m, MOST_SPREAD)
        if max(spread) >= least_px:
            found[n] = spread
    return found


def coarser(raster: PlaneRaster, reduction: int) -> PlaneRaster:
    """The same rectangle in fewer pixels."""
    if reduction == 1:
        return raster
    width, height = max(1, raster.width_px // reduction), max(1, raster.height_px // reduction)
    return replace(
        raster,
        pitch_u_m=raster.pitch_u_m * raster.width_px / width,
        pitch_v_m=raster.pitch_v_m * raster.height_px / height,
        width_px=width,
        height_px=height,
    )


def _weighed_best(lacks: Sequence[I16], slopes: Sequence[F32]) -> F32:
    """The best centre panel for what both eyes lack there by so much weight each, in sixteenths of a code."""
    left, right = (slope * lack for slope, lack in zip(slopes, lacks, strict=True))
    return np.asarray(np.clip((left + right) / (slopes[0] + slopes[1]), 0, FULL), np.float32)


def _clamp_and_quantise(codes: I16, out: I16, *, shown: bool) -> None:
    """Keep within the panel's range; what will be shown is rounded to what 8 bits can show.

    Rounded any earlier, corrections of less than half a code would be lost.
    """
    if shown:
        np.add(codes, SUBCODE // 2, out=codes)
        np.bitwise_and(codes, -SUBCODE, out=codes)
    np.clip(codes, 0, FULL, out=out)
