"""Builds the models that a plan asks for."""

from __future__ import annotations

from runtime.config import ModelSettings, Settings
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.unrolled import UnrolledPredictor
from runtime.optics.stack import PanelStack
from runtime.plan.focus import FocusedPredictor

LADDER = (("best", 1.0), ("balanced", 1.0), ("fast", 1.0), ("fast", 0.75), ("fast", 0.5))


def focused(predictor: Predictor, settings: ModelSettings) -> FocusedPredictor | None:
    """The predictor made to run on windows, where its kind can; None for others (`sart`, whole-picture networks)."""
    if not isinstance(predictor, UnrolledPredictor):
        return None

    def make(part: PanelStack) -> UnrolledPredictor:
        # One session serves every size: loading another for a new window would cost as much as solving it.
        return UnrolledPredictor(
            predictor.session,
            part,
            threads=settings.threads,
            one_channel=predictor.one_channel,
            surroundings=predictor.surroundings,
        )

    return FocusedPredictor(predictor, make)


def planned_predictor(settings: Settings, stack: PanelStack) -> Predictor:
    """The configured model with the savings that the plan allows. Raises InputError, MissingPart."""
    predictor = load_predictor(settings.model.name, stack, settings.model)
    if isinstance(predictor, UnrolledPredictor):
        predictor.one_channel = settings.plan.enabled and settings.plan.one_channel
    if settings.plan.enabled and settings.plan.focus:
        return focused(predictor, settings.model) or predictor
    return predictor
