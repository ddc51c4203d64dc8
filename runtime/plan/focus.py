"""A model that runs only where the two eyes' pictures differ; the rest is filled in, in closed form.

Panels that are cut to a window and moved to its centre are a smaller stack, seen by eyes moved the same way: any
model for evenly spaced panels serves it. Where the eyes agree, the outer panels stand at the middle of their
range, from which the solver starts, and the centre panel carries the picture. What drives the outer panels fades out
towards the window's edge (`model.fade`): there is no seam.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from time import perf_counter_ns

import numpy as np

from runtime.content.base import ContentSource, View
from runtime.model.assembly import Placed, Rest, Shared, Uniform
from runtime.model.fade import Fade
from runtime.model.predictor import Prediction, Predictor
from runtime.model.schedule import Backend, Picture
from runtime.model.unrolled import UnrolledPredictor
from runtime.optics.pupil import PUPIL_SIGMA_MM
from runtime.optics.rect import PixelRect, union
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import raster_from_stack
from runtime.plan.active import (
    Window,
    coarse_box,
    differing_box,
    steepness,
    steepness_beside,
    still_fits,
    wave_px,
    whole_rays,
    window_of,
)
from runtime.records import F64, U8
from runtime.support.gl import DrawnPicture
from runtime.support.threads import at_once

SIZES_KEPT = 6


class FocusedPredictor(Predictor):
    """Wraps a model that draws on the centre panel's pixels and starts with even outer panels.

    Call `aim` before `rasters` where the content may know where it lies: then only the window is drawn, too.
    Without it, the pictures themselves tell where they differ.
    """

    def __init__(self, whole: UnrolledPredictor, make: Callable[[PanelStack], UnrolledPredictor]) -> None:
        """whole: the model for all of the panels; make: the same model for smaller ones of the same pitch."""
        self.whole, self._make = whole, make
        self.name, self.provider, self.parameters = whole.name, whole.provider, whole.parameters
        self.stack = whole.stack
        self._parts: dict[tuple[int, int], UnrolledPredictor] = {}
        self._assembly = whole.surroundings.assembly(whole.stack)
        self._aimed: Window | None = None
        self._background = Uniform((255, 255, 255))  # beside the aimed window
        self.window: Window | None = None  # of the last frame
        self.active_fraction = 1.0  # of the panel's pixels that went through the model

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self.whole.backend

    def reads_textures_of(self, context: object) -> bool:
        return self.whole.reads_textures_of(context)

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        return self.whole.on_panels(stack)

    def surround_with(self, backend: Backend) -> None:
        for part in (self.whole, *self._parts.values()):
            part.surround_with(backend)
        self._assembly.close()
        self._assembly = backend.assembly(self.stack)

    def aim(self, content: ContentSource, eyes_m: F64, *, time_ns: int) -> None:
        """Ask the content where it lies, so that only that is drawn and solved."""
        self._aimed = None
        if content.info.background is None:
            return
        raster = self._middle()
        boxes = []
        for side, eye_m in enumerate(eyes_m):
            view = View(eye_m, side, raster_from_stack(eye_m, raster), raster.width_px, raster.height_px)
            box = content.extent(view, time_ns=time_ns)
            if box is None:
                return
            boxes.append(box)
        box = union(boxes)
        if not box.width_px:
            return
        colour = tuple(round(value * 255) for value in content.info.background)
        steep = max(steepness(np.array([code], np.uint8)) for code in colour)
        wanted = window_of(box, eyes_m, self.stack, steep=steep)
        self._aimed = self._kept(wanted)
        self._background = Uniform(colour)

    @property
    def one_channel(self) -> bool:
        """True where grey pictures are solved in one channel."""
        return self.whole.one_channel

    @property
    def interpolation(self) -> str:
        return self.whole.interpolation

    @property
    def pre_emphasis(self) -> float:
        return self.whole.pre_emphasis

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        return super().windows(eyes_m) if self._aimed is not None else self.whole.windows(eyes_m)

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        """The whole centre panel, or the aimed window of it."""
        if self._aimed is None:
            return self.whole.rasters(eyes_m)
        box, whole = self._aimed.box, self._middle()
        return (
            replace(
                whole,
                left_m=whole.left_m + box.u0 * whole.pitch_u_m,
                top_m=whole.top_m - box.v0 * whole.pitch_v_m,
                width_px=box.width_px,
                height_px=box.height_px,
            ),
        )

    def predict(
        self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        begin_ns = perf_counter_ns()
        left, right = images[0][0], images[1][0]
        aimed, self._aimed = self._aimed, None
        rest: Rest
        if aimed is not None:
            window, cut, rest = aimed, [[left], [right]], self._background
        elif isinstance(left, DrawnPicture) or isinstance(right, DrawnPicture):  # nobody looked where they differ
            return self._whole(images, eyes_m, eye_sigma_mm=eye_sigma_mm)
        else:
            # A coarse look tells for next to nothing what is too large; only the rest is worth a close one.
            box = coarse_box(left, right)
            found = self._around(box, left, eyes_m)
            if not box.width_px or found is not None:
                box = differing_box(left, right, known=box)
                found = self._around(box, left, eyes_m)
            if box.width_px and found is None:
                return self._whole(images, eyes_m, eye_sigma_mm=eye_sigma_mm)
            rest = Shared(left, self.whole.pre_emphasis)
            kept = self._kept(found)
            if kept is None:
                return self._filled(rest, _ms_since(begin_ns))
            window, cut = kept, _cut(images, kept)
        found_ms = _ms_since(begin_ns)
        # Solved before anything is put together: where the model fails, the last good layers stay as they were.
        part = self._part(window.stack)
        part.fade = self._fade(window, eyes_m)
        solved = part.predict(cut, eyes_m - window.shift_m, eye_sigma_mm=eye_sigma_mm)
        self.channels = part.channels
        return self._placed(window, solved, rest, eyes_m, found_ms)

    @property
    def refines(self) -> bool:
        return self.whole.refines and self.active_fraction > 0

    def refine(
        self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        """Of whole pictures, not of those of an aimed window."""
        window, left = self.window, images[0][0]
        if window is None:
            return self.whole.refine(images, eyes_m, eye_sigma_mm=eye_sigma_mm)
        assert not isinstance(left, DrawnPicture)
        begin_ns = perf_counter_ns()
        cut, rest = _cut(images, window), Shared(left, self.whole.pre_emphasis)
        cut_ms = _ms_since(begin_ns)
        part = self._part(window.stack)
        solved = part.refine(cut, eyes_m - window.shift_m, eye_sigma_mm=eye_sigma_mm)
        return self._placed(window, solved, rest, eyes_m, cut_ms)

    def _whole(self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float) -> Prediction:
        """Layers of which nothing can be left out."""
        self.window, self.active_fraction = None, 1.0
        prediction = self.whole.predict(images, eyes_m, eye_sigma_mm=eye_sigma_mm)
        self.channels = self.whole.channels
        return prediction

    def _around(self, box: PixelRect, picture: U8, eyes_m: F64) -> Window | None:
        """The window around a box in which the eyes' pictures differ; None where nothing does, or too much."""
        if not box.width_px:
            return None
        return window_of(box, eyes_m, self.stack, steep=steepness_beside(picture, box))

    def _kept(self, wanted: Window | None) -> Window | None:
        """The last frame's window where it will do: then nothing is allocated again."""
        if wanted is None or self.window is None or not still_fits(self.window, wanted):
            return wanted
        return replace(self.window, steps=wanted.steps)

    def warm_up(self, eyes_m: F64) -> None:
        self.whole.warm_up(eyes_m)
        super().warm_up(eyes_m)

    def close(self) -> None:
        for part in (self.whole, *self._parts.values()):
            part.close()
        self._parts = {}
        self._assembly.close()

    def _filled(self, rest: Rest, found_ms: float) -> Prediction:
        """Layers of which the centre panel alone carries the picture, for both eyes."""
        begin_ns = perf_counter_ns()
        layers = self._assembly.assembled(rest, None)
        self.window, self.active_fraction, self.channels = None, 0.0, 3
        return Prediction(layers, {"prepare": found_ms, "inference": 0.0, "finish": _ms_since(begin_ns)})

    def _placed(self, window: Window, solved: Prediction, rest: Rest, eyes_m: F64, found_ms: float) -> Prediction:
        """The window's layers among the rest."""
        begin_ns = perf_counter_ns()
        # Near the window's edge the centre panel can't know what rays meet that leave the window.
        kept = whole_rays(window, eyes_m, self.stack)
        layers = self._assembly.assembled(rest, Placed(solved.made, window.box, kept))
        self.window = window
        area = window.box
        self.active_fraction = area.width_px * area.height_px / (self.stack.width_px * self.stack.height_px)
        stage_ms = dict(solved.stage_ms)
        stage_ms["prepare"] = stage_ms.get("prepare", 0.0) + found_ms
        stage_ms["finish"] = stage_ms.get("finish", 0.0) + _ms_since(begin_ns)
        return Prediction(layers, stage_ms)

    def _fade(self, window: Window, eyes_m: F64) -> Fade:
        """How a window ends: gently, but where the panels themselves do."""
        box, kept = window.box, whole_rays(window, eyes_m, self.stack)
        return Fade(
            PixelRect(kept.u0 - box.u0, kept.v0 - box.v0, kept.u1 - box.u0, kept.v1 - box.v0),
            over_px=wave_px(eyes_m, self.stack, steps=window.steps),
            left=box.u0 > 0,
            top=box.v0 > 0,
            right=box.u1 < self.stack.width_px,
            bottom=box.v1 < self.stack.height_px,
        )

    def _middle(self) -> PlaneRaster:
        return self.stack.panel(self.stack.count // 2)

    def _part(self, stack: PanelStack) -> UnrolledPredictor:
        size = (stack.width_px, stack.height_px)
        if size not in self._parts:
            while len(self._parts) >= SIZES_KEPT:
                self._parts.pop(next(iter(self._parts))).close()
            self._parts[size] = self._make(stack)
        return self._parts[size]


def _cut(images: Sequence[Sequence[Picture]], window: Window) -> list[list[Picture]]:
    """Both eyes' pictures within a window."""
    parts = [image[window.box.slices] for (image,) in images if not isinstance(image, DrawnPicture)]
    return [[part] for part in at_once(np.ascontiguousarray, parts)]


def _ms_since(begin_ns: int) -> float:
    return (perf_counter_ns() - begin_ns) / 1e6
