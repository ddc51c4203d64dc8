"""The three panels of a solution, with whole corrections in one compiled pass.

Phases are fixed-point (sixteenths of an 8-bit code). Nothing is kept between corrections but the panels: to look at
both outer ones anew takes less time than to write what was seen and read it again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from math import log, sqrt

import cv2
import numpy as np

from runtime.model.compiled.along import ANYWHERE_PX, EDGE_PX, new_layout, work_row, work_tiles
from runtime.model.compiled.loops import PIECE, numbers_of
from runtime.model.compiled.passes import blur, close_centre, correct, extrapolate_rows, fade_codes, show
from runtime.model.compiled.phasors import PhasorState, rays_of
from runtime.model.compiled.warp import warped
from runtime.model.reprojection import CENTRE, EYES, FRONT, MAX_SPREAD_PX, OUTER, REAR, START, reprojection, spreads
from runtime.model.resample import buffer
from runtime.model.targets import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F32, F64, I16, U8
from runtime.support.threads import on_rows

LEAST_TAP = 1e-3  # of a blur's middle one: what weighs less is left out
MAX_TAPS = int(MAX_SPREAD_PX * sqrt(2) * sqrt(2 * log(1 / LEAST_TAP))) + 2  # pixels to either side
FARTHEST = 32000.0  # what 16 bits hold of a panel's mean and half of what both eyes lack
MARGIN = 4 * PIECE  # numbers behind a row that whole pieces may touch
SMALL_PX = 8  # of a raster, either way
WORTH_A_THREAD = 384 * 1024  # numbers; an image of fewer is done before another thread has woken


class Panels:
    """Buffers for one stack; state lives from frame to frame.

    Images are (h, w, 3), or (h, w) where there is one channel.
    """

    def __init__(self, stack: PanelStack, *, threads: int, channels: int = 3) -> None:
        self._stack, self._threads, self._channels = stack, threads, channels
        height, width = stack.height_px, stack.width_px
        names = (*(("outer", n) for n in OUTER), *(("mean", n) for n in OUTER), *(("target", e) for e in EYES))
        self._whole = {name: buffer(height, width, channels=channels) for name in (*names, ("moved", 0), ("spare", 0))}
        self.rasters: tuple[PlaneRaster, ...] = ()
        self.spread: dict[int, tuple[float, float]] = {}  # per outer panel, right and down, pixels

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the centre panel's raster."""
        return self.rasters[CENTRE].width_px, self.rasters[CENTRE].height_px

    def crop(self, rasters: tuple[PlaneRaster, ...], stack: PanelStack, reduction: int = 1) -> None:
        """Cut every buffer to what the eyes look through, of a stack so many times finer than the rasters."""
        self.rasters, self._stack, self._reduction = rasters, stack, reduction
        self.outer = {n: self._view("outer", n, on=n) for n in OUTER}
        self.target = tuple(self._view("target", side, on=CENTRE) for side in EYES)  # phase sums

    def set_eyes(self, eyes_m: F64, *, eye_sigma_mm: float = 0.0) -> None:
        """Correct for eyes (2, 3) that err by so much, an axis: what is left of the outer panels in the mean counts,
        and what moves of them is noise. Spreads too small to be felt on this raster are none."""
        self.spread = spreads(self.rasters, eyes_m, eye_sigma_mm=eye_sigma_mm, reduction=self._reduction)
        places = np.tile(np.eye(3), (2, 3, 1, 1))
        for side in EYES:
            for n in OUTER:
                places[side, n] = reprojection(self._stack, self.rasters, eyes_m[side], of=n, on=CENTRE)
        sizes = [(raster.height_px, raster.width_px) for raster in (*self.rasters, self.rasters[CENTRE])]
        self._sizes = np.array(sizes)
        self._rays = rays_of(places, self._sizes)

    def project(self, panels: Sequence[int]) -> None:
        """Outer panels have changed: what unsure eyes see of them in the mean."""
        for n in panels:
            if n in self.spread:
                self._blur(self.outer[n], self._whole["mean", n], n, self.spread[n])

    def step(self, panel: int, *, size: float, shown: bool, fading: tuple[F32, F32] | None = None) -> None:
        """Change one outer panel by what both eyes still lack; fading: what that is multiplied with, along the centre
        panel's columns and rows.

        With m of a wave left to unsure eyes, the noise is |front - m²·rear|²(1 - m²): its gradient joins the mean's.
        """
        if panel not in self.spread:
            self._correct(panel, size=size, limits=(0.0, FULL), shown=shown, fading=fading)
            outer, spare = ("outer", panel), ("spare", 0)
            self._whole[outer], self._whole[spare] = self._whole[spare], self._whole[outer]
            self.outer[panel] = self._view(*outer, on=panel)
            return
        other = REAR if panel == FRONT else FRONT
        right, down = self.spread[panel]
        self._blur(self._mean(other), self._whole["moved", 0], other, (right * 2**0.5, down * 2**0.5))
        self._correct(panel, size=0.5, limits=(-FARTHEST, FARTHEST), shown=False, fading=fading)
        spread, target = self.spread[panel], self.outer[panel]
        self._blur(self._whole["spare", 0], target, panel, spread, gain=2 * size, most=FULL, shown=shown)

    def set_panel(self, panel: int, coarse: I16, *, shown: bool) -> None:
        """An outer panel as it was drawn on a coarser raster of its box."""
        outer = self.outer[panel]
        cv2.resize(coarse, outer.shape[1::-1], dst=outer, interpolation=cv2.INTER_CUBIC)
        clamp_and_quantise(outer, shown=shown)

    def take(self, coarse: Panels) -> None:
        """The outer panels of a coarser raster, rounded to what 8 bits show, and what unsure eyes see of them."""
        for n in OUTER:
            self.set_panel(n, coarse.outer[n], shown=True)
            mean = self._view("mean", n, on=n)
            cv2.resize(coarse._view("mean", n, on=n), mean.shape[1::-1], dst=mean, interpolation=cv2.INTER_CUBIC)

    def show(self, layers: U8, boxes: Sequence[PixelRect]) -> None:
        """All panels in 8-bit codes, the centre closed, into layers (N, H, W, 4), each within its box."""
        box, pixels = boxes[CENTRE], layers[CENTRE].view(np.uint32)[..., 0]
        panels, targets = tuple(numbers_of(self._mean(n)) for n in OUTER), tuple(map(numbers_of, self.target))
        sizes, seen = self._sizes[[REAR, FRONT, CENTRE]], np.ascontiguousarray(self._rays.seen[:, OUTER])
        constants = self._constants()

        def close(first: int, last: int) -> None:
            place = pixels, box.v0, box.u0, first, last
            work = new_layout(4, self.size[0], self._channels), work_row(self._scale), work_tiles()
            close_centre(panels, sizes, self._near, targets, seen, *place, *constants, *work)

        self._on_rows(CENTRE, close)
        outer = {n: numbers_of(self.outer[n]) for n in OUTER}
        show_panels(outer, layers, boxes, channels=self._channels, threads=self._threads)

    def _correct(
        self, panel: int, *, size: float, limits: tuple[float, float], shown: bool, fading: tuple[F32, F32] | None
    ) -> None:
        """Into `spare`: a panel as it is seen, and so much of what both eyes lack."""
        other = REAR if panel == FRONT else FRONT
        width, height = self.size
        columns, rows = fading if fading is not None else (np.ones(width, np.float32), np.ones(height, np.float32))
        needs, channels = self._rays.needs[panel], self._channels
        ring_rows = int((needs[..., 1] - needs[..., 0]).max()) + 2
        arguments = (
            tuple(numbers_of(self._mean(n)) for n in (panel, other)),
            numbers_of(self._whole["moved", 0]),
            self._sizes[[panel, other, CENTRE]],
            self._near,
            panel in self.spread,
            numbers_of(self._whole["spare", 0]),
            tuple(map(numbers_of, self.target)),
            np.ascontiguousarray(self._rays.seen[:, (panel, other)]),
            np.ascontiguousarray(self._rays.back[:, panel]),
            needs,
            *(np.float32(value) for value in (size, *limits)),
            shown,
            np.repeat(columns, channels),
            rows,
        )

        def work(first: int, last: int) -> None:
            layouts = new_layout(4, width, channels), new_layout(2, self.rasters[panel].width_px, channels)
            ring = np.zeros((4, ring_rows, width * channels + MARGIN), np.int16)
            place = first, last, *self._constants()
            correct(*arguments, *place, *layouts, work_row(self._scale), work_tiles(), ring)

        self._on_rows(panel, work)

    def _blur(
        self,
        image: I16,
        out: I16,
        panel: int,
        spread: tuple[float, float],
        *,
        gain: float = 1.0,
        most: float = 0.0,
        shown: bool = False,
    ) -> None:
        """An outer panel's image as unsure eyes see it in the mean, into `out`, or `gain` of the way there."""
        channels, _, _, subcode = self._constants()
        across, down = (_taps(sigma) for sigma in spread)
        numbers, target = numbers_of(image), numbers_of(out)
        size = self.rasters[panel].height_px, self.rasters[panel].width_px * channels

        def work(first: int, last: int) -> None:
            values = target, np.float32(gain), np.float32(most), shown, target
            rows = np.zeros((2, size[1] + 2 * MAX_TAPS * channels + MARGIN), np.float32)
            blur(numbers, down, across, *values, *size, first, last, channels, subcode, rows)

        self._on_rows(panel, work)

    def _mean(self, panel: int) -> I16:
        """An outer panel as eyes see it that may be unsure."""
        return self._whole["mean", panel] if panel in self.spread else self.outer[panel]

    @property
    def _near(self) -> float:
        """How images end: what lies beside them is even, but where rasters are sheared, or so small that they end
        before a panel does, their edges go on."""
        return ANYWHERE_PX if self._stack.tilt is not None or min(self.size) < SMALL_PX else -EDGE_PX

    @property
    def _scale(self) -> float:
        """How many pixels of one panel lie before one of another, at most."""
        return float(np.abs(np.concatenate([self._rays.seen, self._rays.back])[..., 0, 0]).max())

    def _on_rows(self, panel: int, work: Callable[[int, int], None]) -> None:
        raster = self.rasters[panel]
        large = raster.height_px * raster.width_px * self._channels > WORTH_A_THREAD
        on_rows(work, raster.height_px, threads=self._threads if large else 1)

    def _view(self, name: str, n: int, *, on: int) -> I16:
        """The first rows and columns of a buffer, with margins of its own."""
        parent = self._whole[name, n].base
        assert isinstance(parent, np.ndarray)
        return parent[: self.rasters[on].height_px, : self.rasters[on].width_px]

    def _constants(self) -> tuple[int, np.float32, np.float32, np.float32]:
        return self._channels, np.float32(START), np.float32(FULL), np.float32(SUBCODE)


def show_panels(panels: dict[int, I16], layers: U8, boxes: Sequence[PixelRect], *, channels: int, threads: int) -> None:
    """Panels (rows, numbers) in 8-bit codes, into layers (N, H, W, 4), each within its box."""
    bits = SUBCODE.bit_length() - 1
    for n, numbers in panels.items():
        box, pixels = boxes[n], layers[n].view(np.uint32)[..., 0]

        def copy(first: int, last: int, numbers: I16 = numbers, box: PixelRect = box, pixels: U8 = pixels) -> None:
            show(numbers, pixels, box.v0, box.u0, box.width_px, first, last, channels, bits)

        on_rows(copy, box.height_px, threads=threads)


@cache
def warm_up() -> None:
    """Compile every pass, or load what was compiled before."""
    stack, eyes_m = PanelStack(0.5, 0.25, (-0.06, 0.0, 0.06), 64, 32), np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
    boxes = (PixelRect(0, 0, 64, 32),) * 3
    panels = Panels(stack, threads=1)
    panels.crop(tuple(stack.panel(n) for n in range(stack.count)), stack)
    for sigma_mm in (0.0, 100.0):
        panels.set_eyes(eyes_m, eye_sigma_mm=sigma_mm)
        panels.project(OUTER)
        panels.step(FRONT, size=1.0, shown=True)
    layers = np.zeros((3, 32, 64, 4), np.uint8)
    panels.show(layers, boxes)
    joint = PhasorState(np.array([(32, 64)] * 4), channels=3, threads=1)
    joint.step(panels._rays, size=1.0, momentum=0.5, floor=0.1)
    whole, same = (slice(0, 32), slice(0, 64)), np.eye(3)
    warped(layers[0], same, out=layers[1], rows=whole[0], columns=whole[1])
    fade_codes(np.zeros((2, 6), np.int16), np.zeros((1, 2), np.float32), START, 3)
    every = np.zeros(32, np.int64), np.full(32, 64)
    extrapolate_rows(*(layer.view(np.uint32)[..., 0] for layer in layers[:2]), *every, *every, 0, 0, 64)


def _taps(sigma_px: float) -> F32:
    """(an odd number,) weights of a blur, from the middle outwards."""
    count = max(2, int(sigma_px * sqrt(2 * log(1 / LEAST_TAP))))
    offsets = np.arange(count + 1 + count % 2)
    weights = np.exp(-0.5 * (offsets / max(sigma_px, 1e-3)) ** 2)
    return np.asarray(weights / (2 * weights.sum() - weights[0]), np.float32)


def clamp_and_quantise(codes: I16, *, shown: bool) -> None:
    """Keep within the panel's range, in place; what will be shown is rounded to what 8 bits can show.

    Rounded any earlier, corrections of less than half a code would be lost.
    """
    if shown:
        np.add(codes, SUBCODE // 2, out=codes)
        np.bitwise_and(codes, -SUBCODE, out=codes)
    np.clip(codes, 0, FULL, out=codes)
