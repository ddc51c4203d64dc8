"""States that are replaced as a whole: the presenter's, and the solver's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.eyes.calibration import Calibration
from runtime.model.predictor import Predictor


@dataclass(frozen=True, slots=True)
class RunState:
    """The settings and the calibration that the presenter uses together."""

    version: int  # unique among the states of a run
    settings: Settings
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class SceneState:
    """The settings, content and model that the solver uses together."""

    version: int  # unique among the states of a solver
    scene: int  # changes whenever the content is replaced or moved
    settings: Settings
    content: ContentSource
    predictor: Predictor


class SceneCell:
    """Holds a solver's latest `SceneState`. For use on the solver's thread."""

    def __init__(
        self,
        settings: Settings,
        *,
        content: ContentSource,
        predictor: Predictor,
        version: int = 0,
        scene: int = 1,
        first_number: int = 1,
    ) -> None:
        """Create a cell.

        Args:
            settings: Settings that the content and the model were loaded with.
            content: The scene.
            version: Version of the first state.
            scene: Number of the scene.
            first_number: Number of the first solution. An earlier solver of the run may have used lower ones.
        """
        self._numbers = count(first_number)
        self.state = SceneState(version, scene, settings, content, predictor)

    def next_number(self) -> int:
        """Return a number, unique within the run, for a new solution or flat picture."""
        return next(self._numbers)

    def replace(self, **changes: Any) -> SceneState:
        """Replace some of the state's fields and return the old state.

        The caller must close any content or model that was replaced.
        """
        before = self.state
        scene = before.scene + (changes.get("content", before.content) is not before.content)
        self.state = replace(before, version=before.version + 1, scene=scene, **changes)
        return before
