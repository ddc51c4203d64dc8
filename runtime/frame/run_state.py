"""The immutable state of a run at one moment, replaced as a whole on reconfiguration."""

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

LEFT_BEHIND = "content or model took so long to be made that the solver was made anew: nothing has changed"


@dataclass(frozen=True, slots=True)
class RunState:
    """Settings, calibration, content and model that belong together; the solver owns the last two."""

    version: int  # another number for each value
    settings: Settings
    calibration: Calibration
    content: ContentSource
    predictor: Predictor


class RunCell:
    """Holds the newest RunState. Readers take `state` once and use that; any thread may."""

    def __init__(
        self, settings: Settings, *, calibration: Calibration, content: ContentSource, predictor: Predictor
    ) -> None:
        self._lock = threading.Lock()
        self._numbers = count(1)
        self.generation = 0  # of the newest solver
        self.state = RunState(0, settings, calibration, content, predictor)

    def next_number(self) -> int:
        """Of a solution or a flat picture; none is given twice in a run, whichever solver makes it."""
        with self._lock:
            return next(self._numbers)

    def begin(self) -> int:
        """A new solver's generation; from now on the one before it changes nothing."""
        with self._lock:
            self.generation += 1
            return self.generation

    def replace(self, generation: int | None = None, **changes: Any) -> RunState:
        """Fields of RunState that change; answers the state before, whose parts are the caller's to close.

        generation: of the solver that changes them. Raises Stopped, and changes nothing, where another has begun.
        """
        with self._lock:
            if generation not in (None, self.generation):
                raise Stopped(LEFT_BEHIND)
            before = self.state
            self.state = replace(before, version=before.version + 1, **changes)
            return before
