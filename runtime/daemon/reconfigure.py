"""Other settings while it runs: what they need is made ready beside the loop, and taken over between two turns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.content.loader import ContentLoader
from runtime.daemon.build import WARM_EYES_M
from runtime.eyes.calibration import load_calibration
from runtime.eyes.tracker import Tracker
from runtime.frame.loop import Loop
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.plan.planner import Planner
from runtime.plan.planning import planned_predictor
from runtime.support.background import Job


class Changeover:
    """One change of settings. Nothing changes until all that it needs is ready; where any of it fails, nothing does."""

    def __init__(self, settings: Settings, old: Settings, stack: PanelStack, *, reload_content: bool = False) -> None:
        """Begins to load; returns at once. reload_content: read it again, though its settings are the same.

        Raises InputError for a bad calibration file, before anything has begun.
        """
        self.settings, self._old, self._stack = settings, old, stack
        self._calibration = load_calibration(Path(settings.calibration.file) if settings.calibration.file else None)
        self._loader: ContentLoader | None = None
        self._source: ContentSource | None = None
        self._model: Job[Predictor] | None = None
        self.problem = ""  # one line, where it can't be done
        if reload_content or settings.content != old.content:
            self._loader = ContentLoader(stack)
            self._loader.request(settings.content)
        if _model_part(settings) != _model_part(old):
            self._model = Job("model", lambda: ready_predictor(settings, stack), discard=lambda made: made.close())

    @property
    def progress(self) -> str:
        """What is being made ready, for the status."""
        if self._loader is not None:
            return self._loader.progress or f"loading {self.settings.content.scene}"
        return f"loading model {self.settings.model.name}"

    def poll(self, context: Any) -> bool:
        """True once all is ready, or something failed (`problem`). Uploads to GL: for the loop's thread."""
        if self._loader is not None:
            loaded = self._loader.poll(context)
            if loaded is not None:
                self._loader, self._source, self.problem = None, loaded.source, loaded.problem
        if self._model is not None and self._model.done:
            self.problem = self.problem or self._model.problem
        if self.problem:
            self.abandon()
            return True
        return self._loader is None and (self._model is None or self._model.done)

    def commit(self, loop: Loop) -> None:
        """Take over what is ready."""
        settings = self.settings
        loop.calibration = self._calibration
        if settings.tracker != self._old.tracker:
            loop.tracker = Tracker(settings.tracker)
        loop.apply(settings)
        loop.pipeline.plan_with(Planner(settings, self._stack))
        if self._source is not None:
            loop.pipeline.show(self._source)
        predictor = self._model.take() if self._model is not None else None
        if predictor is not None:
            loop.pipeline.use(predictor).close()
        loop.budget.changed(settings, content=self._source is not None, model=predictor is not None)

    def abandon(self) -> None:
        """It is no longer wanted, or failed: nothing of it stays."""
        if self._source is not None:
            self._source.close()
        if self._model is not None:
            self._model.abandon()
        self._loader = self._source = self._model = None


def ready_predictor(settings: Settings, stack: PanelStack) -> Predictor:
    """The model of the settings, warm. Raises InputError, MissingPart."""
    predictor = planned_predictor(settings, stack)
    predictor.warm_up(np.array(WARM_EYES_M))
    return predictor


def _model_part(settings: Settings) -> Any:
    """All that decides which predictor there is, but the budget."""
    plan = settings.plan
    savings = plan.enabled and (plan.focus, plan.one_channel)
    return settings.model.model_copy(update={"budget_ms": 0.0}), savings
