"""A solver with its GL context, content and model, all created, used and released on one thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

from runtime.config import Settings, changed
from runtime.content.placed import placed_source, placing_of
from runtime.content.registry import prepare_content
from runtime.daemon.reconfigure import Reconfiguration, ready_predictor
from runtime.errors import ContextLost, PhasestackError
from runtime.frame.effort import Costs, simulated_costs
from runtime.frame.messages import (
    Answer,
    Cancel,
    ChangeSettings,
    Done,
    Draw,
    Facts,
    Live,
    Move,
    Order,
    Progress,
    Skip,
    SolverUpdate,
)
from runtime.frame.solver import SceneState, Solver
from runtime.frame.targets import drawn
from runtime.model.backends import Choice, Wanted, choose
from runtime.model.base import trial_eyes_m, warm_up
from runtime.model.buffers import LayerSlots
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.records import SolveRequest
from runtime.support.gl import leave_context, offscreen_context

# Timed solutions on the full raster and on each coarser one. The first compiles shaders, and other processes may delay
# some, so only the shortest times count.
TRIALS = 2, 3

log = logging.getLogger("phasestack.solver")


@dataclass(frozen=True, slots=True)
class SolverSetup:
    """Settings and measurements to start a solver with."""

    settings: Settings
    stack: PanelStack
    simulated: bool = False  # True if the run's clock is simulated; results must then not depend on the machine's speed
    device: Wanted | None = None  # device chosen by an earlier solver; None: as configured
    first_number: int = 1  # number of the first solution
    version: int = 0  # of the solver's state
    scene: int = 1  # number of the scene
    costs: Mapping[int, Mapping[str, float]] | None = None  # costs measured by an earlier solver; None: measure them
    programs: int | None = None  # descriptor of the channel to `daemon.programs`; None: serve programs in this process
    step_s: float = 10.0  # time limit for a step of a solver in its own process


class RunningSolver:
    """`SolverParts` for a run."""

    def __init__(self, setup: SolverSetup, *, context: Any = None, slots: LayerSlots | None = None) -> None:
        """Load the content and the model, for a new or a shared GL context. Raises FatalError, with all closed."""
        settings, stack = setup.settings, setup.stack
        self._slots, self._owns_context = slots, context is None
        with ExitStack() as undo:
            opener = prepare_content(settings.content, stack)
            if context is None:
                context = offscreen_context()
                undo.callback(context.release)
            loaded = ready_predictor(settings, stack, slots=slots, warmed=setup.costs is None)
            undo.callback(loaded.close)
            content = opener(context=context)
            undo.callback(content.close)
            # On a simulated clock, `auto` always means the CPU, because any two runs must match byte for byte.
            device = setup.device or settings.model.backend
            device = "cpu" if setup.simulated and device == "auto" else device
            self.backend: Choice = choose(device, loaded, lambda: context)
            undo.callback(self.backend.backend.close)
            predictor = loaded.bound(backend=self.backend.backend)
            undo.pop_all()
            loaded.close()
        self.context = context
        state = SceneState(setup.version, setup.scene, settings, content, predictor)
        self.solver = Solver(state, stack, first_number=setup.first_number, timed=not setup.simulated)
        self._calibrated = None if setup.costs is None else (predictor, setup.costs)
        self._change: tuple[int, Reconfiguration] | None = None
        self._told = ""  # progress of the change, as last reported

    def step(self, request: SolveRequest) -> SolverUpdate:
        return self.solver.step(request)

    def turn(self, orders: Sequence[Order]) -> list[Answer]:
        answers: list[Answer] = []
        stack = self.solver.stack
        for order in orders:
            match order:
                case ChangeSettings():
                    change = Reconfiguration(
                        order.settings, self.solver.state.settings, stack,
                        reload_content=order.reload_content, slots=self._slots,
                    )  # fmt: skip
                    self._change, self._told = (order.number, change), ""
                case Cancel():
                    if self._change is not None and self._change[0] == order.change:
                        self._change[1].abandon()
                case Move():
                    answers.append(self._done(order.number, partial(self._move, order.placing)))
                case Skip():
                    answers.append(self._done(order.number, partial(self._skip, order.time_ns)))
                case Draw():
                    answers.append(drawn(order, self.solver.state.content, scene=self.solver.state.scene, stack=stack))
        if self._change is not None:
            number, change = self._change
            if change.advance(self.solver, self.context, self.backend.backend):
                self._change = None
                answers.append(Done(number, change.problem, None if change.problem else self.facts))
            elif change.progress != self._told:
                self._told = change.progress
                answers.append(Progress(number, self._told))
        return answers

    @property
    def is_changing(self) -> bool:
        """True while a change is loading."""
        return self._change is not None

    def _done(self, number: int, work: Callable[[], str]) -> Done:
        """Carry out an order and return its answer. If it raises an exception, the present scene stays."""
        try:
            problem = work()
        except ContextLost:
            raise
        except PhasestackError as error:
            problem = str(error)
        except (Exception, SystemExit) as error:
            log.exception("order")
            problem = f"unexpected error ({type(error).__name__}); see the log"
        return Done(number, problem, None if problem else self.facts)

    def _move(self, placing: Mapping[str, Any]) -> str:
        state = self.solver.state
        settings = changed(state.settings, "content", dict(placing), source="place")
        self.solver.replace(settings=settings, content=placed_source(state.content, placing_of(settings.content)))
        return ""

    def _skip(self, time_ns: int) -> str:
        if self.solver.state.content.skip(time_ns=time_ns):
            return ""
        return "there is no next entry because the scene is not a playlist or is already at its last entry"

    @property
    def facts(self) -> Facts:
        state, predictor = self.solver.state, self.solver.state.predictor
        return Facts(
            state.version,
            state.scene,
            state.settings,
            state.content.info,
            predictor.facts,
            predictor.backend,
            self.backend.why,
        )

    def live(self, time_ns: int) -> Live:
        content = self.solver.state.content
        return Live(
            content.problem,
            content.program,
            content.describe(time_ns=time_ns),
            self.solver.seeing,
            self.solver.measured,
        )

    def simulated_costs(self) -> Costs:
        return simulated_costs(
            self.solver.state.settings.loop.simulated_stage_ms, self.solver.state.predictor.facts.reductions
        )

    def first_costs(self, *, time_ns: int) -> Mapping[int, Mapping[str, float]]:
        predictor = self.solver.state.predictor
        if self._calibrated is None or self._calibrated[0] is not predictor:
            self._calibrated = predictor, self._trial_costs(predictor, time_ns=time_ns)
        return self._calibrated[1]

    def _trial_costs(self, predictor: Predictor, *, time_ns: int) -> Mapping[int, Mapping[str, float]]:
        """Return each raster's shortest stage times. If the content cannot be drawn yet, return those of warm-up."""
        costs: dict[int, dict[str, float]] = {}
        eyes_m = trial_eyes_m(predictor.stack)
        try:
            for reduction in predictor.facts.reductions:
                count = TRIALS[reduction > 1]
                runs = [self.solver.trial_ms(eyes_m, reduction, time_ns=time_ns) for _ in range(count)]
                costs[reduction] = {stage: min(run.get(stage, 0.0) for run in runs) for stage in runs[0]}
        except ContextLost:
            raise
        except (Exception, SystemExit):  # including a `sys.exit()` in a vendor's code; the first step reports it
            return warm_up(predictor)
        return costs

    def close(self) -> None:
        if self._change is not None:
            self._change[1].abandon()
        state = self.solver.state
        own = [leave_context, self.context.release] if self._owns_context else []
        for release in (state.content.close, state.predictor.close, self.backend.backend.close, *own):
            try:
                release()
            except Exception as error:  # for example because the context was lost
                log.warning("error while closing the solver: %s", error)
