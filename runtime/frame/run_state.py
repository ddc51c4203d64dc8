"""A run's immutable state, replaced as a whole by each reconfiguration."""

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

SOLVER_ABANDONED = "the scene or the model took too long to load, so the solver was restarted with the old settings"


@dataclass(frozen=True, slots=True)
class RunState:
    """The settings, calibration, content and model that a run uses together.

    The solver owns the content and the model.
    """

    version: int  # unique among the states of a run
    settings: Settings
    calibration: Calibration
    content: ContentSource
    predictor: Predictor


class RunCell:
    """Holds the latest `RunState` and replaces it atomically.

    Any thread may read `state`. To use several fields, read `state` only once, because it may be replaced between two
    reads.
    """

    def __init__(
        self, settings: Settings, *, calibration: Calibration, content: ContentSource, predictor: Predictor
    ) -> None:
        self._lock = threading.Lock()
        self._numbers = count(1)
        self.generation = 0  # number of the latest solver
        self.state = RunState(0, settings, calibration, content, predictor)

    def next_number(self) -> int:
        """Return a number, unique within the run, for a new solution or flat picture."""
        with self._lock:
            return next(self._numbers)

    def begin(self) -> int:
        """Begin a new solver generation and return its number.

        After this, solvers from older generations can no longer change the state.
        """
        with self._lock:
            self.generation += 1
            return self.generation

    def replace(self, generation: int | None = None, **changes: Any) -> RunState:
        """Replace some of the state's fields and return the old state.

        The caller must close any content or model that was replaced.

        Args:
            generation: The calling solver's generation. None replaces the state in any generation.
            changes: New values, keyed by field name.

        Raises:
            Stopped: A newer generation has begun. The state is not changed.
        """
        with self._lock:
            if generation not in (None, self.generation):
                raise Stopped(SOLVER_ABANDONED)
            before = self.state
            self.state = replace(before, version=before.version + 1, **changes)
            return before
