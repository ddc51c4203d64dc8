"""Draw target pictures for given eyes on the solver's thread, in its GL context."""

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

Wanted = Mapping[str, tuple[F64, int]]  # by field of `RefreshTargets`: eyes (2, 3), frame `stack`, and an instant


class TargetDrawer:
    """Draws targets between the solver's steps."""

    def __init__(
        self,
        solver: SolverHost,
        stack: PanelStack,
        *,
        fov_deg: Callable[[], float],
        shown_content: Callable[[], object | None] = lambda: None,
    ) -> None:
        """Create a drawer of targets.

        fov_deg: function that returns the targets' present field of view, which a reload may change. shown_content:
        function that returns the run's present content, or None if it is never replaced.
        """
        self._solver, self._stack, self.fov_deg = solver, stack, fov_deg
        self.shown_content = shown_content

    def draw(self, wanted: Wanted, content: object | None, then: Callable[[RefreshTargets | None], None]) -> None:
        """Draw the wanted pictures and pass them to `then`, on the solver's thread.

        content: the run's content at that refresh; None: the present one. `then` receives None if drawing failed (the
        run's state gives the reason) or the content has been replaced.
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
