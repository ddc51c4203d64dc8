"""One frame, start to end: eyes to pictures to layers to panels. No threads, no sleeping."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from runtime.content.base import ContentSource, View
from runtime.errors import ContentFailure, ModelFailure
from runtime.frame.timing import StageTimes
from runtime.model.flat import flat_layers
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.plan.planner import Planner, focused_part, observed
from runtime.plan.reuse import ReuseGate
from runtime.plan.savings import Measured, Plan, seeing_eyes, solved_eyes
from runtime.records import F64, U8, Inference, PlanItem

log = logging.getLogger("phasestack.pipeline")

FLAT_EYE_M = (0.7, 0.0, 0.0)  # where the flat picture is drawn from before any viewer was seen


def raster_views(eyes_m: F64, raster: PlaneRaster) -> tuple[View, View]:
    """Left and right eye's views of one raster; eyes (2, 3), frame `stack`."""
    left, right = (
        View(eye, side, raster_from_stack(eye, raster), raster.width_px, raster.height_px)
        for side, eye in enumerate(eyes_m)
    )
    return left, right


def retina_view(eye_m: F64, side: int, *, width_px: int, height_px: int, fov_deg: float) -> View:
    """The view of an eye's own image, looking at the stack's origin."""
    projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    return View(eye_m, side, projection, width_px, height_px)


def drawn_for(predictor: Predictor, content: ContentSource, eyes_m: F64, *, time_ns: int) -> list[list[U8]]:
    """images[side][raster] that a model wants for eyes (2, 3), aimed where the content lies.

    Copied only where a source's array would be drawn over by the next raster: else they are the source's own.
    """
    images: list[list[U8]] = [[], []]
    part = focused_part(predictor)
    if part is not None:
        part.aim(content, eyes_m, time_ns=time_ns)
    rasters = predictor.rasters(eyes_m)
    for raster in rasters:
        for view in raster_views(eyes_m, raster):
            picture = content.render(view, time_ns=time_ns)
            images[view.side].append(picture.copy() if len(rasters) > 1 else picture)
    return images


@dataclass(slots=True)
class Drawn:
    """What one turn put together."""

    layers: U8
    inference: Inference
    missing: dict[str, str] = field(default_factory=dict)  # parts that failed: content, model
    unchanged: bool = False  # the same layers as the turn before


class Pipeline:
    """Content and model for one stack. Keeps the last good layers, and answers with them when a part fails."""

    def __init__(
        self,
        stack: PanelStack,
        *,
        content: ContentSource,
        predictor: Predictor,
        planner: Planner | None = None,
        on_fault: Callable[[str], None] = lambda part: None,
    ) -> None:
        """planner: says what is left out; None: nothing is."""
        self.stack, self.content, self.predictor, self.planner = stack, content, predictor, planner
        self.measured = Measured()  # what is known of the plan's times and errors
        self.plan: Plan | None = None
        self._gate: ReuseGate | None = None
        self._seeing = (True, True)
        self._watched: F64 | None = None  # the eyes that `_seeing` was told from
        self._shown: tuple[int, float] | None = None  # which array was answered last, and how flat
        self._on_fault = on_fault
        self._solved: U8 | None = None  # the last layers for two eyes
        self._solved_for: tuple[Any, ...] | None = None
        self._flat: U8 | None = None
        self._flat_for: tuple[Any, ...] | None = None
        self._middle_m = np.array(FLAT_EYE_M)
        self._redrawn = False
        self._blend = np.empty((stack.count, stack.height_px, stack.width_px, 4), np.uint8)
        self.missing: dict[str, str] = {}
        self._replan()

    def show(self, content: ContentSource) -> None:
        """Other content from now on; the last good layers stay until its first picture is solved."""
        previous, self.content = self.content, content
        previous.close()
        self._replan()

    def use(self, predictor: Predictor) -> Predictor:
        """Another model from now on. Answers the one before it, which is the caller's to close."""
        previous, self.predictor = self.predictor, predictor
        self._replan()
        return previous

    def plan_with(self, planner: Planner | None) -> None:
        """Other settings of what may be left out."""
        self.planner = planner
        self._replan()

    def plan_items(self, measured: Measured | None = None) -> tuple[PlanItem, ...]:
        """What is left out now, with what is known of its time and error."""
        if self.planner is None:
            return ()
        numbers = observed(measured or self.measured, self.predictor)
        plan = self.planner.plan(self.content.info, self.predictor, seeing=self._seeing, measured=numbers)
        return plan.items

    def _replan(self) -> None:
        """What may be left out has changed: the content, the model, the viewer or the settings have."""
        plan = None
        if self.planner is not None:
            plan = self.planner.plan(self.content.info, self.predictor, seeing=self._seeing)
        self.plan = plan
        self._gate = None
        if plan is not None and plan.reuse and plan.most_band_m > 0:
            self._gate = ReuseGate(most_m=plan.most_band_m, band_m=plan.dead_band_m)
        self.forget()

    def _watch(self, eyes_m: F64) -> None:
        """Make the plan again when an eye leaves the viewing range, or returns."""
        if self.planner is None:
            return
        seeing = seeing_eyes(eyes_m, self._seeing, range_deg=self.planner.settings.plan.range_deg)
        if seeing != self._seeing:
            self._seeing = seeing
            log.info("plan: %s", _who_sees(seeing))
            self._replan()

    def draw(
        self, eyes_m: F64 | None, *, flatness: float, time_ns: int, stages: StageTimes, resting: bool = False
    ) -> Drawn:
        """Layers for two eyes (2, 3), frame `stack`, blended with the flat picture.

        flatness: 0 solved for the eyes, 1 flat. resting: the eyes are no estimate of this moment but where a still
        head is; they are solved for as they are. A part that fails is named in `missing` and its last good
        answer is used.
        """
        inference: Inference = "skipped"
        self.missing = {}
        if flatness < 1.0 and eyes_m is not None:
            inference = self._solve(eyes_m, time_ns=time_ns, stages=stages, resting=resting)
        if flatness > 0.0 or self._solved is None:
            self._draw_flat(time_ns=time_ns, stages=stages)
        flatness = flatness if self._solved is not None else 1.0
        layers = self._blended(flatness)
        shown = (id(layers), flatness)
        unchanged = shown == self._shown and inference != "ran" and not self._redrawn
        self._shown, self._redrawn = shown, False
        return Drawn(layers, inference, dict(self.missing), unchanged)

    def forget(self) -> None:
        """Drop what was drawn: the content, the model or the settings have changed."""
        self._solved_for = self._flat_for = None
        if self._gate is not None:
            self._gate.forget()

    def _solve(self, eyes_m: F64, *, time_ns: int, stages: StageTimes, resting: bool) -> Inference:
        if eyes_m is not self._watched:
            self._watched = eyes_m
            self._watch(eyes_m)
        if self.plan is not None:
            eyes_m = solved_eyes(eyes_m, self.plan)
        revision = self.content.revision(time_ns=time_ns)
        solved_for = self._solved_for if self._solved is not None else None
        if solved_for == (eyes_m.tobytes(), revision):
            return "reused"
        gate = self._gate if not resting else None
        still = gate is not None and gate.may_reuse(eyes_m, time_ns=time_ns)
        if still and solved_for is not None and revision == solved_for[1]:
            return "reused"
        if gate is not None:
            eyes_m = gate.best_guess(eyes_m)
        key = (eyes_m.tobytes(), revision)
        try:
            images = drawn_for(self.predictor, self.content, eyes_m, time_ns=time_ns)
        except Exception as error:
            self._failed("content", error, expected=ContentFailure)
            stages.lap("render")
            return "reused" if self._solved is not None else "skipped"
        stages.lap("render")
        try:
            prediction = self.predictor.predict(images, eyes_m)
        except Exception as error:
            self._failed("model", error, expected=ModelFailure)
            stages.lap("inference")
            return "reused" if self._solved is not None else "skipped"
        stages.laps(prediction.stage_ms, rest="finish")
        self._solved, self._solved_for = prediction.layers, key
        if self._gate is not None:
            self._gate.solved(eyes_m)
        self._middle_m = eyes_m.mean(axis=0)
        return "ran"

    def _draw_flat(self, *, time_ns: int, stages: StageTimes) -> None:
        # The viewpoint of the flat picture stays where it was drawn first: without a viewer nothing should move.
        key = (self.content.revision(time_ns=time_ns),)
        if self._flat is not None and key == self._flat_for:
            return
        try:
            raster = self.stack.panel(self.stack.count // 2)
            middle = self._middle_m
            view = View(middle, 0, raster_from_stack(middle, raster), raster.width_px, raster.height_px)
            self._flat = flat_layers(self.content.render(view, time_ns=time_ns), self.stack)
            self._flat_for = key
            self._redrawn = True
        except Exception as error:
            self._failed("content", error, expected=ContentFailure)
            if self._flat is None:
                self._flat = flat_layers(
                    np.full((self.stack.height_px, self.stack.width_px, 4), 255, np.uint8), self.stack
                )
        stages.lap("render")

    def _blended(self, flatness: float) -> U8:
        if flatness >= 1.0:
            assert self._flat is not None
            return self._flat
        assert self._solved is not None
        if flatness <= 0.0 or self._flat is None:
            return self._solved
        import cv2

        for solved, flat, out in zip(self._solved, self._flat, self._blend, strict=True):
            cv2.addWeighted(solved, 1.0 - flatness, flat, flatness, 0.0, dst=out)
        return self._blend

    def _failed(self, part: str, error: Exception, *, expected: type[Exception]) -> None:
        self.missing[part] = str(error).splitlines()[0] if str(error) else type(error).__name__
        self._on_fault(part)
        if isinstance(error, expected):
            log.warning("%s: %s", part, error)
        else:
            log.exception("%s: unexpected error", part)

    def close(self) -> None:
        """Release content and model. May be called twice."""
        self.content.close()
        self.predictor.close()


def _who_sees(seeing: tuple[bool, bool]) -> str:
    """One line for the log."""
    match seeing:
        case (True, False):
            return "the right eye can't see the display: solved for the left one alone"
        case (False, True):
            return "the left eye can't see the display: solved for the right one alone"
    return "solved for both eyes"
