"""Immutable state of a run, which a reconfiguration replaces as a whole."""

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

SOLVER_ABANDONED = "content or model took too long to load, so the solver was restarted; nothing has changed"


@dataclass(frozen=True, slots=True)
class RunState:
    """Settings, calibration, content and model that are used together.

    The solver owns the content and the model.
    """

    version: int  # number that differs for every state of a run
    settings: Settings
    calibration: Calibration
    content: ContentSource
    predictor: Predictor


class RunCell:
    """Holds the newest `RunState` and replaces it atomically.

    Any thread may read `state`. Callers that need several fields should read `state` once, because it may be replaced
    between two reads.
    """

    def __init__(
        self, settings: Settings, *, calibration: Calibration, content: ContentSource, predictor: Predictor
    ) -> None:
        self._lock = threading.Lock()
        self._numbers = count(1)
        self.generation = 0  # number of the newest solver
        self.state = RunState(0, settings, calibration, content, predictor)

    def next_number(self) -> int:
        """Return a number for a new solution or flat picture, unique within the run."""
        with self._lock:
            return next(self._numbers)

    def begin(self) -> int:
        """Begin a new solver generation and return its number.

        Solvers of older generations can no longer change the state.
        """
        with self._lock:
            self.generation += 1
            return self.generation

    def replace(self, generation: int | None = None, **changes: Any) -> RunState:
        """Replace fields of the state and return the old state.

        The caller must close the parts that were replaced.

        Args:
            generation: Generation of the calling solver. None replaces the state in any generation.
            changes: New values by field name.

        Raises:
            Stopped: A newer generation has begun. The state is not changed.
        """
        with self._lock:
            if generation not in (None, self.generation):
                raise Stopped(SOLVER_ABANDONED)
            before = self.state
            self.state = replace(before, version=before.version + 1, **changes)
            return before
