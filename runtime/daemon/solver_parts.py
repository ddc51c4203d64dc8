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

log = logging.getLogger("phasestack.solver")

WARM_EYES_M = ((0.6, -0.031, 0.0), (0.6, 0.031, 0.0))


class RunningSolver:
    """`SolverParts` of a real run; made and used on one thread."""

    def __init__(
        self, run: RunCell, stack: PanelStack, *, context: Any, owns_context: bool, backend: Choice, simulated: bool
    ) -> None:
        """context: current on this thread; owns_context: it is released with the rest. backend: of every model."""
        self.run, self.context, self.backend = run, context, backend
        self._owns_context = owns_context
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
        wanted = settings.model.backend
        if wanted != self._wanted_backend:
            self.backend = choose(wanted, predictor, lambda: self.context)
            self._wanted_backend = wanted
        predictor.surround_with(self.backend.backend)

    def use(self, predictor: Predictor) -> Predictor:
        """Another model from the next solution on. Answers the one before it, which is the caller's to close."""
        predictor.surround_with(self.backend.backend)
        return self.run.replace(predictor=predictor).predictor

    def tell_level(self, label: str, saving: Saving) -> None:
        """What the plan says of the level that is shown."""
        self.solver.measured = replace(self.solver.measured, level=label, level_saving=saving)

    def step(self, request: SolveRequest) -> Step:
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
        state = self._held if abandoned else self.run.state
        for release in (state.content.close, state.predictor.close, *([self.context.release] * self._owns_context)):
            try:
                release()
            except Exception as error:  # of a context that is lost there is nothing to release
                log.warning("solver: closing it: %s", error)


class SolverMaker:
    """Makes a solver on the thread that calls; again, with the settings of then, where the one before it hung."""

    def __init__(
        self, settings: Settings, stack: PanelStack, calibration: Calibration, *, on_start: Callable[[str], bool]
    ) -> None:
        """on_start: told what takes long before the first solution; False: leave it."""
        self._settings, self._stack, self._calibration, self._on_start = settings, stack, calibration, on_start
        self.run: RunCell | None = None  # from the first solver on
        self.parts: RunningSolver | None = None  # the newest
        self._wanted: Wanted = settings.model.backend

    def __call__(self, *, context: Any = None, simulated: bool = False) -> RunningSolver:
        """context: one to share; None: one of this thread's own. Raises FatalError; leaves nothing open then."""
        own = context is None
        made = offscreen_context() if own else context
        try:
            settings = self.run.state.settings if self.run is not None else self._settings
            predictor = ready_predictor(settings, self._stack)
            try:
                content = open_content(settings.content, self._stack, made, limits=settings.limits)
                try:
                    backend = self._chosen(predictor, made, simulated=simulated)
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
            self.run, self._stack, context=made, owns_context=own, backend=backend, simulated=simulated
        )
        parts.budget.start(self._on_start)
        self.parts = parts
        return parts

    def _chosen(self, predictor: Predictor, context: Any, *, simulated: bool) -> Choice:
        """The backend; the one that was found before, where a solver is made anew.

        Simulated time has no use for a faster one, and two of its runs are the same to the byte.
        """
        wanted = "opencv" if simulated and self._wanted == "auto" else self._wanted
        choice = choose(wanted, predictor, lambda: context)
        self._wanted = "gl" if choice.backend.name == "gl" else "opencv"
        return choice


def ready_predictor(settings: Settings, stack: PanelStack) -> Predictor:
    """The model of the settings, warm. Raises InputError, MissingPart."""
    predictor = planned_predictor(settings, stack)
    try:
        predictor.warm_up(np.array(WARM_EYES_M))
    except BaseException:
        predictor.close()
        raise
    return predictor
