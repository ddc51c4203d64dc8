"""State of a solver, replaced as a whole."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.model.predictor import Predictor


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
        """Create a cell of loaded content and model. An earlier solver of the run may have used lower numbers."""
        self._numbers = count(first_number)
        self.state = SceneState(version, scene, settings, content, predictor)

    def next_number(self) -> int:
        """Return a number, unique within the run, for a new solution or flat picture."""
        return next(self._numbers)

    def replace(self, **changes: Any) -> SceneState:
        """Replace fields of the state and return the old one, whose replaced parts the caller must close."""
        before = self.state
        scene = before.scene + (changes.get("content", before.content) is not before.content)
        self.state = replace(before, version=before.version + 1, scene=scene, **changes)
        return before
