"""Target pictures at given eyes: asked for by the presenter, and drawn by the solver."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from runtime.content.base import ContentSource
from runtime.errors import ContentFailure
from runtime.evaluation.refresh_quality import RefreshTargets
from runtime.frame.messages import Answer, Draw, Drawn, Wanted
from runtime.frame.solver_host import SolverHost
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import retina_pictures
from runtime.plan.focusing import focus_targets, may_focus


class TargetDrawer:
    """Has target pictures drawn between solver steps. For use on the presenter's thread."""

    def __init__(self, solver: SolverHost) -> None:
        """Create a target drawer that asks a solver."""
        self._solver = solver

    @property
    def fov_deg(self) -> float:
        """The target pictures' current field of view, which a reload may change."""
        return self._solver.facts.settings.content.fov_deg

    @property
    def scene(self) -> int:
        """The current scene's number, which changes when it is replaced or moved."""
        return self._solver.facts.scene

    @property
    def may_focus(self) -> bool:
        """True if the current content might get pictures for points of the pupils."""
        facts = self._solver.facts
        return may_focus(facts.info, facts.settings.content.focus)

    def draw(self, wanted: Wanted, scene: int | None, then: Callable[[RefreshTargets | None], None]) -> None:
        """Have the wanted pictures drawn for a scene's number, by default the present one, and pass them to
        `then`. It is called on the presenter's thread, with None if the scene was replaced or drawing failed.
        """

        def answered(answer: Answer) -> None:
            assert isinstance(answer, Drawn)
            then(answer.targets)

        self._solver.send(Draw(wanted, scene, self.fov_deg), answered)

    def look(self) -> None:
        """Pass on pictures that have been drawn. Only needed while there are no refreshes."""
        self._solver.news()


def drawn(order: Draw, content: ContentSource, *, scene: int, stack: PanelStack) -> Drawn:
    """Draw target pictures, on the solver's thread, unless the order names another scene's number."""
    if order.scene not in (None, scene):
        return Drawn(order.number, None)
    with suppress(ContentFailure):
        pictures: dict[str, Any] = {
            name: focus_targets(content, eyes_m, stack, time_ns=time_ns)
            if name == "focused"
            else retina_pictures(content, eyes_m, stack, fov_deg=order.fov_deg, time_ns=time_ns)
            for name, (eyes_m, time_ns) in order.wanted.items()
        }
        return Drawn(order.number, RefreshTargets(order.fov_deg, **pictures))
    return Drawn(order.number, None)
