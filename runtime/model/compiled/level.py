"""The three panels on one raster, with whole corrections in one compiled pass.

Nothing is kept between corrections but the panels: to look at both outer ones anew takes less time than to write what
was seen and read it again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import ceil, log, sqrt

import numpy as np
from numpy.typing import NDArray

from runtime.model.compiled.enlarge import enlarge
from runtime.model.compiled.fade import fade_codes
from runtime.model.compiled.passes import STRIP_ROWS, blur, close_centre, correct, show
from runtime.model.compiled.sampling import SLACK, Samplings, numbers_of, samplings, work_row, work_tiles
from runtime.model.compiled.unseen import extrapolate_rows
from runtime.model.compiled.warp import warped
from runtime.model.pyramid_level import (
    CENTRE,
    EYES,
    FRONT,
    MOST_SPREAD,
    OUTER,
    REAR,
    START,
    Fading,
    PyramidLevel,
    reprojection,
)
from runtime.model.resample import buffer
from runtime.model.rows import RowPool
from runtime.model.transfer import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F32, F64, I16, U8

LEAST_PX = 8  # of a raster, either way: smaller ones end before a panel does, and OpenCV repeats their edges
SCALE_MOST = 4.0  # between two panels; eyes that see more of one than so are served by OpenCV
LEAST_TAP = 1e-3  # of a blur's middle one: what weighs less is left out
TAPS_MOST = int(MOST_SPREAD * sqrt(2) * sqrt(2 * log(1 / LEAST_TAP))) + 2  # pixels to either side
FARTHEST = 32000.0  # what 16 bits hold of a panel's mean and half of what both eyes lack


class CompiledLevel(PyramidLevel):
    """A `PyramidLevel` whose corrections are compiled, but for tilted panels."""

    def __init__(self, stack: PanelStack, *, reduction: int, rows: RowPool, channels: int = 3) -> None:
        super().__init__(stack, reduction=reduction, rows=rows, channels=channels)
        height, width = self._whole["outer", FRONT, 0].shape[:2]
        self._spare, self._moved, *means = (buffer(height, width, channels=channels) for _ in range(4))
        self._means = dict(zip(OUTER, means, strict=True))  # what unsure eyes see of the outer panels
        numbers = (width + 2 * TAPS_MOST) * channels + SLACK
        residual_rows = ceil((STRIP_ROWS + 1) * SCALE_MOST) + 3
        self._work = [
            _Work(
                work_row(SCALE_MOST),
                work_tiles(),
                np.zeros((4, residual_rows, numbers), np.int16),
                np.zeros((2, numbers), np.float32),
            )
            for _ in range(rows.threads)
        ]
        self._eyes_m: F64 | None = None  # where these are valid:
        self._seen_at: Samplings | None = None  # outer panels on the centre one; None: not compiled for these eyes
        self._back_at: dict[int, Samplings] = {}  # the centre panel on each outer one

    def crop(self, boxes: Sequence[PixelRect], stack: PanelStack) -> None:
        super().crop(boxes, stack)
        self._eyes_m = self._seen_at = None

    def project(self, panels: Sequence[int], eyes_m: F64) -> None:
        if self._sampling(eyes_m) is None:
            super().project(panels, eyes_m)
            return
        for n in panels:  # every pass samples for itself
            if n in self.spread:
                self._blur(self.outer[n], self._means[n], raster=self.rasters[n], spread=self.spread[n])

    def step(self, panel: int, eyes_m: F64, *, size: float, shown: bool, fading: Fading | None = None) -> None:
        if self._sampling(eyes_m) is None:
            super().step(panel, eyes_m, size=size, shown=shown, fading=fading)
        elif panel in self.spread:
            other = REAR if panel == FRONT else FRONT
            right, down = self.spread[panel]
            twice = right * 2**0.5, down * 2**0.5
            self._blur(self._in_the_mean(other), self._moved, raster=self.rasters[other], spread=twice)
            self._correct(panel, size=0.5, limits=(-FARTHEST, FARTHEST), shown=False, fading=fading, unsure=True)
            # The mean's gradient and the noise's (`PyramidLevel.correct`), blurred together.
            self._blur(
                self._spare,
                self.outer[panel],
                raster=self.rasters[panel],
                spread=self.spread[panel],
                gain=2 * size,
                most=FULL,
                shown=shown,
            )
        else:
            self._correct(panel, size=size, limits=(0.0, FULL), shown=shown, fading=fading, unsure=False)
            key = ("outer", panel, 0)
            self._spare, self._whole[key] = self._whole[key], self._spare
            self.outer[panel] = self._view(*key, on=panel)

    def upsample(self, coarser: PyramidLevel, *, shown: bool) -> None:
        panels = [(coarser.outer[n], self.outer[n]) for n in OUTER]
        if any(fine.shape[:2] != (2 * image.shape[0], 2 * image.shape[1]) for image, fine in panels):
            super().upsample(coarser, shown=shown)
            return
        channels, _, full, subcode = self._constants()

        def work(first: int, last: int, _: _Work) -> None:
            for image, fine in panels:
                height, width = fine.shape[0], image.shape[1]
                rows = height * first // self.size[1], height * last // self.size[1]
                numbers = [np.empty((width + margin) * channels, np.float32) for margin in (4, 0, 0)]
                enlarge(
                    numbers_of(image),
                    image.shape[0],
                    width,
                    channels,
                    numbers_of(fine),
                    *rows,
                    shown,
                    full,
                    subcode,
                    *numbers,
                )

        self._on_rows(self.size[1], work)

    def show(self, layers: U8, boxes: Sequence[PixelRect]) -> None:
        seen = self._seen_at
        if seen is None:
            super().show(layers, boxes)
            return
        constants, floor = self._constants(), np.float32(self.slope_floor)
        panels = [numbers_of(self._in_the_mean(n)) for n in OUTER]
        widths = [self.rasters[n].width_px * self._channels for n in OUTER]
        wanted = [numbers_of(image) for image in self.target]

        def close(first: int, last: int, work: _Work) -> None:
            place = _pixels(layers[CENTRE]), boxes[CENTRE].v0, boxes[CENTRE].u0
            rows = first, last, *constants, floor, work.row, work.tiles
            close_centre(*panels, *widths, *wanted, seen, *place, *rows)

        self._on_rows(boxes[CENTRE].height_px, close)
        for n in OUTER:
            self._copy(self.outer[n], layers[n], boxes[n])

    def _copy(self, panel: I16, layer: U8, box: PixelRect) -> None:
        self._copy_numbers(numbers_of(panel), layer, box)

    def show_panels(self, panels: I16, layers: U8, boxes: Sequence[PixelRect]) -> None:
        for numbers, layer, box in zip(panels, layers, boxes, strict=True):
            self._copy_numbers(numbers, layer, box)

    def _copy_numbers(self, numbers: I16, layer: U8, box: PixelRect) -> None:
        pixels, bits = _pixels(layer), SUBCODE.bit_length() - 1

        def copy(first: int, last: int, _: _Work) -> None:
            show(numbers, pixels, box.v0, box.u0, box.width_px, first, last, self._channels, bits)

        self._on_rows(box.height_px, copy)

    def _in_the_mean(self, panel: int) -> I16:
        return self._means[panel] if panel in self.spread else self.outer[panel]

    def _correct(
        self, panel: int, *, size: float, limits: tuple[float, float], shown: bool, fading: Fading | None, unsure: bool
    ) -> None:
        """Into `_spare`: a panel as it is seen, and so much of what both eyes lack."""
        centre, other = self.rasters[CENTRE], REAR if panel == FRONT else FRONT
        channels, start, full, subcode = self._constants()
        columns: F32 = np.ones(centre.width_px, np.float32) if fading is None else fading.columns
        down: F32 = np.ones(centre.height_px, np.float32) if fading is None else fading.rows
        arguments = (
            *(numbers_of(image) for image in (self._in_the_mean(panel), self._in_the_mean(other), self._moved)),
            *(self.rasters[n].width_px * channels for n in (panel, other)),
            2 * OUTER.index(panel),
            unsure,
            numbers_of(self._spare),
            *(numbers_of(image) for image in self.target),
            self._seen_at,
            self._back_at[panel],
            *(np.float32(value) for value in (size, self.slope_floor, *limits)),
            shown,
            np.repeat(columns, channels),
            down,
        )

        def work(index: int, of: int) -> None:
            work = self._work[index]
            correct(*arguments, index, of, channels, start, full, subcode, work.row, work.tiles, work.residual)

        self._rows.split(self.outer[panel].size, work)

    def _blur(
        self,
        image: I16,
        out: I16,
        *,
        raster: PlaneRaster,
        spread: tuple[float, float],
        gain: float = 1.0,
        most: float = 0.0,
        shown: bool = False,
    ) -> None:
        """What is left of an image in the mean over eyes that are unsure, into `out`, or `gain` of the way there."""
        channels, _, _, subcode = self._constants()
        across, down = (_taps(sigma) for sigma in spread)
        numbers, target = numbers_of(image), numbers_of(out)
        size = raster.height_px, raster.width_px * channels

        def work(first: int, last: int, work: _Work) -> None:
            values = target, np.float32(gain), np.float32(most), shown, target
            blur(numbers, down, across, *values, *size, first, last, channels, subcode, work.rows)

        self._on_rows(raster.height_px, work)

    def _sampling(self, eyes_m: F64) -> Samplings | None:
        """Where these eyes (2, 3) see the outer panels; None where the compiled passes don't serve them."""
        if self._eyes_m is None or not np.array_equal(self._eyes_m, eyes_m):
            self._eyes_m, self._seen_at = eyes_m.copy(), None
            if self._stack.tilt is None and min(self.size) >= LEAST_PX:
                self._lay(eyes_m)
        return self._seen_at

    def _lay(self, eyes_m: F64) -> None:
        seen = [reprojection(self._stack, self.rasters, eye_m, of=n, on=CENTRE) for n in OUTER for eye_m in eyes_m]
        back = {n: [reprojection(self._stack, self.rasters, eye_m, of=CENTRE, on=n) for eye_m in eyes_m] for n in OUTER}
        scales = [m[k, k] for m in (*seen, *back[REAR], *back[FRONT]) for k in (0, 1)]
        if min(scales) <= 0 or max(scales) > SCALE_MOST:
            return
        self._seen_at = self._laid(seen, on=CENTRE, of=[n for n in OUTER for _ in EYES])
        self._back_at = {n: self._laid(back[n], on=n, of=[CENTRE for _ in EYES]) for n in OUTER}

    def _laid(self, matrices: Sequence[F64], *, on: int, of: Sequence[int]) -> Samplings:
        raster = self.rasters[on]
        sizes = [(self.rasters[n].height_px, self.rasters[n].width_px) for n in of]
        return samplings(matrices, height=raster.height_px, width=raster.width_px, sizes=sizes, channels=self._channels)

    def _on_rows(self, height_px: int, work: Callable[[int, int, _Work], None]) -> None:
        """`work` on as many rows for each thread."""

        def share(index: int, of: int) -> None:
            work(height_px * index // of, height_px * (index + 1) // of, self._work[index])

        self._rows.split(height_px * self.rasters[CENTRE].width_px * self._channels, share)

    def _constants(self) -> tuple[int, np.float32, np.float32, np.float32]:
        return self._channels, np.float32(START), np.float32(FULL), np.float32(SUBCODE)


@cache
def warm_up() -> None:
    """Compile every pass, or load what was compiled before."""
    stack, eyes_m = PanelStack(0.5, 0.25, (-0.06, 0.0, 0.06), 64, 32), np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
    boxes, rows = (PixelRect(0, 0, 64, 32),) * 3, RowPool(1, width_px=64)
    coarse, level = (CompiledLevel(stack, reduction=reduction, rows=rows) for reduction in (2, 1))
    coarse.crop(boxes, stack)
    level.crop(boxes, stack)
    level.upsample(coarse, shown=True)
    for sigma_mm in (0.0, 100.0):
        level.set_eye_sigma(eyes_m, eye_sigma_mm=sigma_mm)
        level.project(OUTER, eyes_m)
        level.step(FRONT, eyes_m, size=1.0, shown=True)
    layers = np.zeros((3, 32, 64, 4), np.uint8)
    level.show(layers, boxes)
    whole, same = (slice(0, 32), slice(0, 64)), np.eye(3)
    for linear in (False, True):
        warped(layers[0], same, out=layers[1], rows=whole[0], columns=whole[1], linear=linear)
    fade_codes(np.zeros((2, 6), np.int16), np.zeros((1, 2), np.float32), START, 3)
    every = np.zeros(32, np.int64), np.full(32, 64)
    extrapolate_rows(_pixels(layers[0]), _pixels(layers[1]), *every, *every, 0, 0, 64)
    rows.close()


@dataclass(frozen=True, slots=True)
class _Work:
    """What one thread works in."""

    row: F32  # `work_row`
    tiles: F32  # `work_tiles`
    residual: I16  # (4, rows, numbers)
    rows: F32  # (2, numbers)


def _taps(sigma_px: float) -> F32:
    """(an odd number,) weights of a blur, from the middle outwards."""
    count = max(2, int(sigma_px * sqrt(2 * log(1 / LEAST_TAP))))
    offsets = np.arange(count + 1 + count % 2)
    weights = np.exp(-0.5 * (offsets / max(sigma_px, 1e-3)) ** 2)
    return np.asarray(weights / (2 * weights.sum() - weights[0]), np.float32)


def _pixels(layer: U8) -> NDArray[np.uint32]:
    """(rows, pixels) of RGBA (rows, pixels, 4)."""
    return layer.view(np.uint32)[..., 0]
