"""A solver with its GL context, content, model and time budget: what one solver thread makes, uses and releases."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.content.registry import open_content
from runtime.errors import ContextLost
from runtime.eyes.calibration import Calibration
from runtime.frame.run_state import RunCell, RunState
from runtime.frame.solver import Solver, Step
from runtime.frame.timing import SOLVING_STAGES
from runtime.model.backends import Choice, Wanted, choose
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.plan.budget import BudgetControl
from runtime.plan.predictors import planned_predictor
from runtime.plan.savings import Saving
from runtime.records import SolveRequest
from runtime.support.gl import offscreen_context
from runtime.support.gl_sharing import ShareGroup, SharingContext, leave_context

log = logging.getLogger("phasestack.solver")

PanelsGroup = Callable[[], ShareGroup | None]  # that panels show textures of at present

WARM_EYES_M = ((0.6, -0.031, 0.0), (0.6, 0.031, 0.0))


class RunningSolver:
    """`SolverParts` of a real run; made and used on one thread."""

    def __init__(
        self,
        run: RunCell,
        stack: PanelStack,
        *,
        context: Any,
        owns_context: bool,
        group: ShareGroup | None,
        panels_group: PanelsGroup,
        backend: Choice,
        simulated: bool,
    ) -> None:
        """context: current on this thread; owns_context: it is released with the rest. group: the context's, if any;
        panels_group: the one that panels show textures of at present. backend: of every model."""
        self.run, self.context, self.backend = run, context, backend
        self._owns_context = owns_context
        self._group, self._panels_group = group, panels_group
        self._wanted_backend = run.state.settings.model.backend
        self._held: RunState = run.state
        self.solver = Solver(run, stack)
        self.budget = BudgetControl(self, stack, simulated=simulated)

    @property
    def settings(self) -> Settings:
        """Those in force."""
        return self.run.state.settings

    @property
    def content(self) -> ContentSource:
        """What is drawn at present."""
        return self.run.state.content

    def surround(self, predictor: Predictor, settings: Settings) -> None:
        """Have this run's backend surround a model; chosen anew where the settings ask for another.

        Raises PhasestackError where that can't be had; nothing has changed then.
        """
        wanted, before = settings.model.backend, self.backend
        if wanted != self._wanted_backend:
            self.backend = choose(wanted, predictor, lambda: self.context, group=self._group)
            self._wanted_backend = wanted
        predictor.surround_with(self.backend.backend)
        if before is not self.backend:
            before.backend.close()

    def surround_level(self, predictor: Predictor) -> None:
        """Have this run's backend surround a model that a budget may choose."""
        predictor.surround_with(self.backend.backend)

    def use(self, predictor: Predictor) -> Predictor:
        """Another model, surrounded already, from the next solution on. Answers the one before it, which is the
        caller's to close."""
        return self.run.replace(predictor=predictor).predictor

    def tell_level(self, label: str, saving: Saving) -> None:
        """What the plan says of the level that is shown."""
        self.solver.measured = replace(self.solver.measured, level=label, level_saving=saving)

    def step(self, request: SolveRequest) -> Step:
        if self._panels_group() is not self._group or (self._group is not None and self._group.lost):
            raise ContextLost("the panels have another OpenGL context")
        self._held = self.run.state
        step = self.solver.step(request)
        solution = step.solution
        stages = self.simulated_stage_ms() if self.budget.simulated else solution.stage_ms if solution else {}
        took_ms = sum(stages.get(stage, 0.0) for stage in SOLVING_STAGES) if solution is not None else None
        self.budget.step(eyes_m=request.eyes_m, time_ns=request.time_ns, took_ms=took_ms)
        return step

    def simulated_stage_ms(self) -> Mapping[str, float]:
        return self.budget.stage_ms

    def close(self, *, abandoned: bool = False) -> None:
        self.budget.close()
        stand_in = self._stand_in()
        state = self._held if abandoned else self.run.state
        own = [leave_context, self.context.release] if self._owns_context else []
        own += [] if stand_in is None else [stand_in.release]
        for release in (state.content.close, state.predictor.close, self.backend.backend.close, *own):
            try:
                release()
            except Exception as error:  # of a context that is lost there is nothing to release
                log.warning("solver: closing it: %s", error)

    def _stand_in(self) -> SharingContext | None:
        """A context of the group, current: textures outlive the solver's own, which may be lost, and are released in
        this one. None: they go with their context."""
        if not self._owns_context or self._group is None or self._group.lost:
            return None
        try:
            return self._group.stand_in()
        except Exception as error:
            log.warning("solver: its textures stay: %s", error)
            return None


class SolverMaker:
    """Makes a solver on the thread that calls; again, with the settings of then, where the one before it hung."""

    def __init__(
        self,
        settings: Settings,
        stack: PanelStack,
        calibration: Calibration,
        *,
        on_start: Callable[[str], bool],
        panels_group: PanelsGroup = lambda: None,
    ) -> None:
        """on_start: told what takes long before the first solution; False: leave it. panels_group: the share group
        that solutions are shown from, asked from any thread."""
        self._settings, self._stack, self._calibration, self._on_start = settings, stack, calibration, on_start
        self.run: RunCell | None = None  # from the first solver on
        self.parts: RunningSolver | None = None  # the newest
        self._wanted: Wanted = settings.model.backend
        self._panels_group = panels_group

    def __call__(self, *, context: Any = None, simulated: bool = False) -> RunningSolver:
        """context: one to use together with the panels; None: one of this thread's own, which shares textures with
        theirs where that can be. Raises FatalError; leaves nothing open then."""
        own, group = context is None, self._shared_group()
        made = context if context is not None else own_context(group)
        try:
            settings = self.run.state.settings if self.run is not None else self._settings
            predictor = ready_predictor(settings, self._stack)
            try:
                content = open_content(settings.content, self._stack, made, limits=settings.limits)
                try:
                    backend = self._chosen(predictor, made, group, simulated=simulated)
                    predictor.surround_with(backend.backend)
                except BaseException:
                    content.close()
                    raise
            except BaseException:
                predictor.close()
                raise
        except BaseException:
            if own:
                made.release()
            raise
        if self.run is None:
            self.run = RunCell(settings, calibration=self._calibration, content=content, predictor=predictor)
        else:
            self.run.replace(content=content, predictor=predictor)
        parts = RunningSolver(
            self.run,
            self._stack,
            context=made,
            owns_context=own,
            group=group,
            panels_group=self._shared_group,
            backend=backend,
            simulated=simulated,
        )
        parts.budget.start(self._on_start)
        self.parts = parts
        return parts

    def _shared_group(self) -> ShareGroup | None:
        """Of the panels, where solutions may be left in textures; a solver that never draws any is kept apart."""
        group = None if self._settings.model.backend == "opencv" else self._panels_group()
        return None if group is None or group.lost else group

    def _chosen(self, predictor: Predictor, context: Any, group: ShareGroup | None, *, simulated: bool) -> Choice:
        """The backend; the one that was found before, where a solver is made anew.

        Simulated time has no use for a faster one, and two of its runs are the same to the byte.
        """
        wanted = "opencv" if simulated and self._wanted == "auto" else self._wanted
        choice = choose(wanted, predictor, lambda: context, group=group)
        self._wanted = "gl" if choice.backend.name == "gl" else "opencv"
        return choice


def own_context(group: ShareGroup | None) -> Any:
    """A context for this thread, current on it, of a group if there is one. Raises MissingPart."""
    return offscreen_context() if group is None else group.context()


def ready_predictor(settings: Settings, stack: PanelStack) -> Predictor:
    """The model of the settings, warm. Raises InputError, MissingPart."""
    predictor = planned_predictor(settings, stack)
    try:
        predictor.warm_up(np.array(WARM_EYES_M))
    except BaseException:
        predictor.close()
        raise
    return predictor
