"""Draw target pictures for given eyes on the solver's thread, in the solver's GL context."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from runtime.errors import ContentFailure
from runtime.evaluation.refresh_quality import RefreshTargets
from runtime.frame.solver_host import SolverHost
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import retina_pictures
from runtime.records import F64

Wanted = Mapping[str, tuple[F64, int]]  # eyes (2, 3) in frame `stack` and a time, keyed by field of `RefreshTargets`


class TargetDrawer:
    """Draws target pictures between solver steps."""

    def __init__(
        self,
        solver: SolverHost,
        stack: PanelStack,
        *,
        fov_deg: Callable[[], float],
        shown_content: Callable[[], object | None] = lambda: None,
    ) -> None:
        """Create a target drawer.

        Args:
            solver: Host of the solver whose thread draws the pictures.
            stack: The display's panels.
            fov_deg: Function that returns the target pictures' current field of view, which a reload may change.
            shown_content: Function that returns the run's current content, or None if the content is never replaced.
        """
        self._solver, self._stack, self.fov_deg = solver, stack, fov_deg
        self.shown_content = shown_content

    def draw(self, wanted: Wanted, content: object | None, then: Callable[[RefreshTargets | None], None]) -> None:
        """Draw the wanted pictures on the solver's thread, and pass them to `then`.

        Args:
            wanted: Eyes and time to draw each pair of pictures for, keyed by field of `RefreshTargets`.
            content: The run's content at the refresh to draw for. None means the current content.
            then: Function called with the pictures on the solver's thread, or with None if `content` has been replaced
                or drawing has failed. In the latter case, the run's state gives the reason.
        """

        def task(parts: Any) -> bool:
            targets = None
            try:
                with suppress(ContentFailure):
                    if content is None or parts.content is content:
                        targets = self._drawn(parts.content, wanted)
            finally:
                then(targets)
            return True

        self._solver.do(task)

    def _drawn(self, content: Any, wanted: Wanted) -> RefreshTargets:
        fov_deg = self.fov_deg()
        pictures = {
            name: retina_pictures(content, eyes_m, self._stack, fov_deg=fov_deg, time_ns=time_ns)
            for name, (eyes_m, time_ns) in wanted.items()
        }
        return RefreshTargets(fov_deg, **pictures)
