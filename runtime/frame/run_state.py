"""Immutable state of a run. A reconfiguration replaces it as a whole."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.errors import Stopped
from runtime.eyes.calibration import Calibration
from runtime.model.predictor import Predictor

LEFT_BEHIND = "the scene or the model took too long to load, so the solver was restarted with the old settings"


@dataclass(frozen=True, slots=True)
class RunState:
    """Settings, calibration, content and model that belong together; the solver owns the last two."""

    version: int  # a different number for each state
    settings: Settings
    calibration: Calibration
    content: ContentSource
    predictor: Predictor


class RunCell:
    """Holder of the newest RunState. Any thread may read `state`, which should be read once per use."""

    def __init__(
        self, settings: Settings, *, calibration: Calibration, content: ContentSource, predictor: Predictor
    ) -> None:
        self._lock = threading.Lock()
        self._numbers = count(1)
        self.generation = 0  # number of the newest solver
        self.state = RunState(0, settings, calibration, content, predictor)

    def next_number(self) -> int:
        """Return the next number for a solution or flat picture. It is unique within the run."""
        with self._lock:
            return next(self._numbers)

    def begin(self) -> int:
        """Begin a new solver generation and return its number. Older ones can no longer change the state."""
        with self._lock:
            self.generation += 1
            return self.generation

    def replace(self, generation: int | None = None, **changes: Any) -> RunState:
        """Replace fields of the state and return the old one, whose replaced parts the caller must close.

        generation: number of the calling solver's. If a newer one has begun, raises Stopped and changes nothing.
        """
        with self._lock:
            if generation not in (None, self.generation):
                raise Stopped(LEFT_BEHIND)
            before = self.state
            self.state = replace(before, version=before.version + 1, **changes)
            return before
