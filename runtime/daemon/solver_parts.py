"""A solver with its GL context, content and model, all created, used and released on one thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

from runtime.config import ContentSettings, Settings
from runtime.content.base import ContentSource
from runtime.content.registry import Opener, prepare_content
from runtime.errors import ContextLost, Stopped
from runtime.eyes.calibration import Calibration
from runtime.frame.effort import Costs, simulated_costs
from runtime.frame.run_state import RunCell, RunState
from runtime.frame.solver import Solver, SolverUpdate
from runtime.model.backends import Choice, Wanted, choose
from runtime.model.base import trial_eyes_m
from runtime.model.predictor import Predictor, load_predictor
from runtime.optics.stack import PanelStack
from runtime.records import SolveRequest
from runtime.support.gl import leave_context, offscreen_context

# Timed solutions on the full raster and on each coarser one. The first compiles shaders, and other processes may delay
# some, so only the shortest times count.
TRIALS = 2, 3

log = logging.getLogger("phasestack.solver")


@dataclass(eq=False)
class RunningSolver:
    """`SolverParts` for a run. Created and used on one thread."""

    run: RunCell
    solver: Solver
    backend: Choice  # device to run the solver on, with any model
    context: Any  # GL context, current on this thread
    owns_context: bool  # True if `close` also releases the context
    contexts_lost: Callable[[], int]  # returns the number of contexts lost by the panels
    generation: int  # this solver's number within the run
    _calibrated: tuple[Predictor, Mapping[int, Mapping[str, float]]] | None = field(init=False, default=None)
    _owned: RunState = field(init=False)  # `close` releases this state's parts if another solver has started

    def __post_init__(self) -> None:
        self._owned, self._lost_before = self.run.state, self.contexts_lost()

    @property
    def is_newest(self) -> bool:
        """True until another solver starts. After that, this solver must not change the run."""
        return self.run.generation == self.generation

    def replace(self, **changes: Any) -> RunState:
        """Replace parts of the run's state and return the old state, like `RunCell.replace`.

        Raises Stopped if another solver has started.
        """
        before = self.run.replace(self.generation, **changes)
        self._owned = replace(before, **changes)
        return before

    @property
    def content(self) -> ContentSource:
        """The current content."""
        return self.run.state.content

    def step(self, request: SolveRequest) -> SolverUpdate:
        if self.contexts_lost() != self._lost_before:
            raise ContextLost("the panels have lost their OpenGL context")
        state = self.run.state  # must be read before checking whether another solver has started
        if not self.is_newest:
            raise Stopped("this solver was abandoned")
        self._owned = state
        return self.solver.step(request, state)

    def simulated_costs(self) -> Costs:
        return simulated_costs(self.run.state.settings.loop.simulated_stage_ms, self.run.state.predictor.reductions)

    def first_costs(self, *, time_ns: int) -> Mapping[int, Mapping[str, float]]:
        predictor = self.run.state.predictor
        if self._calibrated is None or self._calibrated[0] is not predictor:
            self._calibrated = predictor, self._trial_costs(predictor, time_ns=time_ns)
        return self._calibrated[1]

    def _trial_costs(self, predictor: Predictor, *, time_ns: int) -> Mapping[int, Mapping[str, float]]:
        """Return each raster's shortest stage times. If the content cannot be drawn yet, return those of warm-up."""
        costs: dict[int, dict[str, float]] = {}
        eyes_m = trial_eyes_m(predictor.stack)
        try:
            for reduction in predictor.reductions:
                count = TRIALS[reduction > 1]
                runs = [self.solver.trial_ms(eyes_m, reduction, time_ns=time_ns) for _ in range(count)]
                costs[reduction] = {stage: min(run.get(stage, 0.0) for run in runs) for stage in runs[0]}
        except ContextLost:
            raise
        except (Exception, SystemExit):  # including a `sys.exit()` in a vendor's code; the first step reports it
            return predictor.warmed_ms
        return costs

    def close(self) -> None:
        state = self.run.state if self.is_newest else self._owned
        own = [leave_context, self.context.release] if self.owns_context else []
        for release in (state.content.close, state.predictor.close, self.backend.backend.close, *own):
            try:
                release()
            except Exception as error:  # for example because the context was lost
                log.warning("error while closing the solver: %s", error)


class SolverMaker:
    """Creates a solver at startup and after each hang. Called on the new solver's thread."""

    def __init__(
        self,
        settings: Settings,
        stack: PanelStack,
        calibration: Calibration,
        *,
        contexts_lost: Callable[[], int] = lambda: 0,
    ) -> None:
        """Create a factory for one run's solvers.

        Args:
            settings: Settings for the first solver. Later solvers use the run's current settings.
            stack: The run's panels.
            calibration: The run's calibration.
            contexts_lost: Function that returns the number of GL contexts lost by the panels. May be called on any
                thread.
        """
        self._settings, self._stack, self._calibration = settings, stack, calibration
        self.run: RunCell | None = None  # None until the first solver exists
        self.parts: RunningSolver | None = None  # the latest solver
        self._device: Wanted = settings.model.backend
        self._contexts_lost = contexts_lost
        self._prepared: tuple[ContentSettings, Opener] | None = None  # content that was read but not yet opened

    def __call__(self, *, context: Any = None, simulated: bool = False) -> RunningSolver:
        """Create a solver with the current settings. If this fails, everything that it opened is closed.

        Args:
            context: GL context to share with the panels. None creates a new context.
            simulated: True if the run's clock is simulated.

        Raises:
            FatalError: The content or the model cannot be used.
        """
        own = context is None
        generation = self.run.begin() if self.run is not None else 0
        settings = self.run.state.settings if self.run is not None else self._settings
        with ExitStack() as undo:
            opener = self._opener(settings.content)
            if own:
                context = offscreen_context()
                undo.callback(context.release)
            predictor = ready_predictor(settings, self._stack)
            undo.callback(predictor.close)
            self._prepared = None
            content = opener(context=context)
            undo.callback(content.close)
            backend = self._chosen(predictor, context, simulated=simulated)
            undo.callback(backend.backend.close)
            predictor.set_backend(backend.backend)
            if self.run is None:
                self.run = RunCell(settings, calibration=self._calibration, content=content, predictor=predictor)
            else:
                self.run.replace(generation, content=content, predictor=predictor)
            undo.pop_all()
        parts = RunningSolver(
            self.run,
            Solver(self.run, self._stack, timed=not simulated),
            backend,
            context,
            owns_context=own,
            contexts_lost=self._contexts_lost,
            generation=generation,
        )
        if parts.is_newest:
            self.parts = parts
        return parts

    def _opener(self, content: ContentSettings) -> Opener:
        """Return the content's opener. If a previous solver read this content but never opened it, reuse it."""
        prepared = self._prepared
        if prepared is None or prepared[0] != content:
            prepared = self._prepared = content, prepare_content(content, self._stack)
        return prepared[1]

    def _chosen(self, predictor: Predictor, context: Any, *, simulated: bool) -> Choice:
        """Choose the device to run the solver on. After a restart, the device stays the same.

        On a simulated clock, `auto` always means the CPU, because any two runs must match byte for byte.
        """
        device = "cpu" if simulated and self._device == "auto" else self._device
        choice = choose(device, predictor, lambda: context)
        self._device = "gl" if choice.backend.name == "gl" else "cpu"
        return choice


def ready_predictor(settings: Settings, stack: PanelStack) -> Predictor:
    """Load the configured model and warm it up.

    Raises:
        InputError: The model cannot be used.
        MissingPart: A package required by the model is not installed.
    """
    predictor = load_predictor(settings.model.name, stack, settings.model)
    try:
        predictor.warm_up(trial_eyes_m(stack))
    except BaseException:
        predictor.close()
        raise
    return predictor
