"""A model at fewer pixels than the panels have, its layers enlarged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter_ns
from typing import Any

from runtime.config import Settings
from runtime.model.assembly import ArrayAssembly, Assembly
from runtime.model.predictor import Prediction, Predictor
from runtime.model.schedule import Backend
from runtime.optics.pupil import PUPIL_SIGMA_MM
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.plan.predictors import planned_predictor
from runtime.records import F64


class ReducedPredictor(Predictor):
    """Wraps a model for a stack of the same size with fewer pixels."""

    def __init__(self, small: Predictor, stack: PanelStack) -> None:
        """small: the model for the same panels at fewer pixels; stack: the panels as they are."""
        self.small, self.stack = small, stack
        self.name, self.provider, self.parameters = small.name, small.provider, small.parameters
        self._assembly: Assembly = ArrayAssembly(stack)

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self.small.backend

    def reads_textures_of(self, context: object) -> bool:
        return self.small.reads_textures_of(context)

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        return self.small.on_panels(stack)

    def surround_with(self, backend: Backend) -> None:
        self.small.surround_with(backend)
        self._assembly.close()
        self._assembly = backend.assembly(self.stack)

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return self.small.rasters(eyes_m)

    @property
    def interpolation(self) -> str:
        return self.small.interpolation

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        return self.small.windows(eyes_m)

    def predict(
        self, images: Sequence[Sequence[Any]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        return self._enlarged(self.small.predict(images, eyes_m, eye_sigma_mm=eye_sigma_mm))

    @property
    def refines(self) -> bool:
        return self.small.refines

    def refine(
        self, images: Sequence[Sequence[Any]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        return self._enlarged(self.small.refine(images, eyes_m, eye_sigma_mm=eye_sigma_mm))

    def _enlarged(self, solved: Prediction) -> Prediction:
        begin_ns = perf_counter_ns()
        layers = self._assembly.enlarged(solved.made)
        stage_ms = dict(solved.stage_ms)
        stage_ms["finish"] = stage_ms.get("finish", 0.0) + (perf_counter_ns() - begin_ns) / 1e6
        return Prediction(layers, stage_ms)

    def close(self) -> None:
        self.small.close()
        self._assembly.close()


def ladder_predictor(name: str, scale: float, stack: PanelStack, settings: Settings) -> Predictor:
    """One level of the ladder: a model at a share of the panels' columns and rows, focused where the plan says so."""
    chosen = settings.model_copy(update={"model": settings.model.model_copy(update={"name": name})})
    if scale == 1.0:
        return planned_predictor(chosen, stack)
    small = replace(stack, width_px=round(stack.width_px * scale), height_px=round(stack.height_px * scale))
    return ReducedPredictor(planned_predictor(chosen, small), stack)
