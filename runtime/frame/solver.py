"""Draw content and compute layers for the predicted eyes, on the thread that owns the GL context."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from itertools import count
from time import perf_counter_ns
from typing import Any

import numpy as np

from runtime.clock import NS_PER_MS, Stopwatch
from runtime.config import Settings
from runtime.content.base import ContentSource, View
from runtime.errors import ContentFailure, ContextLost, ModelFailure
from runtime.frame.messages import SolverUpdate
from runtime.frame.meter import SolutionMeter
from runtime.frame.policy import FramePolicy, SolutionKey
from runtime.model.geometry import TargetView
from runtime.model.job import Job, SolveWindow
from runtime.model.predictor import Predictor
from runtime.model.targets import flat_layers
from runtime.optics.stack import PanelStack
from runtime.optics.views import raster_from_stack
from runtime.plan.drawing import drawn_job
from runtime.plan.focusing import focused_job
from runtime.plan.savings import Measured, Plan, make_plan, seeing_eyes
from runtime.records import F64, U8, Effort, Eyes, Solution, SolveRequest
from runtime.support.gl import DrawnPicture

log = logging.getLogger("phasestack.solver")

FLAT_EYE_M = (0.7, 0.0, 0.0)  # the flat picture's viewpoint until a viewer has been seen


@dataclass(frozen=True, slots=True)
class SceneState:
    """The settings, content and model that a solver uses together."""

    version: int  # unique among the states of a run
    scene: int  # changes whenever the content is replaced or moved
    settings: Settings
    content: ContentSource
    predictor: Predictor


class Solver:
    """Computes at most one solution or flat picture in each step."""

    def __init__(self, state: SceneState, stack: PanelStack, *, first_number: int = 1, timed: bool = True) -> None:
        """Create a solver whose solutions are numbered from `first_number`.

        On a simulated clock, `timed` is False, and `model.budget_ms` does not apply.
        """
        self.state, self.stack, self._timed = state, stack, timed
        self._numbers = count(first_number)
        self.measured = Measured()  # times and errors measured for each item of the plan
        self.plan: Plan | None = None
        self._planned_for: tuple[int, tuple[bool, ...]] | None = None
        self.seeing: tuple[bool, ...] = (True, True)  # for each eye, True if it can see the display
        self._policy = FramePolicy()
        self._solved: SolutionKey | None = None
        self._flat: SolutionKey | None = None
        self._windows: dict[int, SolveWindow | None] = {}  # window of the latest solution, keyed by reduction
        self._kept: Job | None = None  # last job, with its pictures copied; None: draw them again
        self._meter = SolutionMeter()
        self._middle_m: F64 = np.array(FLAT_EYE_M)
        self._missing: dict[str, str] = {}

    def replace(self, **changes: Any) -> SceneState:
        """Replace fields of the state and return the old one, whose replaced parts the caller must close."""
        before = self.state
        scene = before.scene + (changes.get("content", before.content) is not before.content)
        self.state = replace(before, version=before.version + 1, scene=scene, **changes)
        return before

    def step(self, request: SolveRequest) -> SolverUpdate:
        """Carry out a request and return the results.

        If the content or the model fails, the update names the failed part, and all earlier results remain valid.
        Raises ContextLost, after which this solver can no longer be used.
        """
        state = self.state
        self._replan(request.eyes_m)
        time_ns = request.time_ns
        try:
            revision = state.content.revision(time_ns=time_ns)
        except (Exception, SystemExit) as error:  # including a `sys.exit()` in a vendor's code
            return SolverUpdate(missing=self._failed("content", error, expected=ContentFailure))
        job = self._policy.next_job(
            request,
            plan=self.plan,
            state_version=state.version,
            revision=revision,
            solved=self._solved,
            flat=self._flat,
        )
        if job.kind == "flat":
            return self._draw_flat(revision=revision, time_ns=time_ns)
        if job.eyes_m is not None:
            wanted = request.refined_to if job.kind == "refine" else request.effort
            facts = state.predictor.facts  # may be those of a new model
            if wanted is None or wanted.reduction not in facts.reductions:
                wanted = Effort(1, facts.steps)
            elif job.kind == "solve":
                wanted = replace(wanted, steps=min(wanted.steps, facts.steps))
            return self._solve(request, job.eyes_m, wanted, revision=revision)
        if request.eyes_m is not None and not request.paused:
            self._missing = {}  # the latest solution already fulfils the request
        return SolverUpdate(missing=dict(self._missing))

    def trial_ms(self, eyes_m: Eyes, reduction: int, *, time_ns: int) -> dict[str, float]:
        """Draw and solve once in one step, discard the result, and return the stage times in ms. Raises
        ContentFailure, ModelFailure, or ContextLost, after which this solver can no longer be used.
        """
        state, watch = self.state, Stopwatch()
        plan = state.settings.plan
        job = drawn_job(
            state.predictor, state.content, eyes_m,
            time_ns=time_ns, reduction=reduction, trimmed=plan.enabled, in_depth=plan.align,
        )  # fmt: skip
        watch.lap("render")
        state.predictor.solve(replace(job, steps=1), watch)
        return watch.stage_ms

    def _solve(self, request: SolveRequest, eyes_m: Eyes, effort: Effort, *, revision: int) -> SolverUpdate:
        state, settings, watch = self.state, self.state.settings.model, Stopwatch()
        sigma_m = request.sigma_m if settings.eye_sigma_mm == "auto" else settings.eye_sigma_mm / 1e3
        limited = self._timed and settings.budget_ms > 0
        deadline_ns = perf_counter_ns() + round(settings.budget_ms * NS_PER_MS) if limited else None
        continued = effort.continued_from is not None and self._kept is not None
        try:
            if continued:
                assert self._kept is not None
                job = self._kept
            else:
                job = self._drawn(request, eyes_m, effort.reduction)
            if effort.focus:
                focused = focused_job(state.content, job, time_ns=request.time_ns, focus=state.settings.content.focus)
                if focused is None:  # the present solution stays, and is not asked for again
                    assert self._solved is not None and self._solved.effort is not None
                    self._solved = replace(self._solved, effort=replace(self._solved.effort, focus=True))
                    return SolverUpdate(missing=dict(self._missing))
                job = focused
        except ContextLost:  # content and model were lost with it, so the owner must start another solver
            raise
        except (Exception, SystemExit) as error:
            return SolverUpdate(missing=self._failed("content", error, expected=ContentFailure))
        watch.lap("render")
        job = replace(job, eye_sigma_m=sigma_m, deadline_ns=deadline_ns, steps=effort.steps, continued=continued)
        try:
            prediction = state.predictor.solve(job, watch)
        except ContextLost:
            raise
        except (Exception, SystemExit) as error:
            return SolverUpdate(missing=self._failed("model", error, expected=ModelFailure))
        effort = Effort(effort.reduction, prediction.steps, prediction.continued_from, effort.focus)
        self._missing = {}
        self._windows[effort.reduction] = job.window if job.window is not None and job.window.box.width_px else None
        self.measured = replace(self.measured, left_out=prediction.savings)
        self._solved = SolutionKey(state.version, revision, eyes_m, effort)
        self._middle_m = eyes_m.mean(axis=0)
        solution = Solution(
            next(self._numbers),
            prediction.layers,
            eyes_m,
            request.time_ns,
            seeing=self.plan.eyes if self.plan is not None else (True,) * len(eyes_m),
            eye_sigma_m=sigma_m,
            stage_ms=watch.stage_ms,
            effort=effort,
            measures=None
            if effort.focus
            else self._meter.measure(job, prediction.layers, effort, time_ns=request.time_ns),
            relief=job.relief,
            state_version=state.version,
            people=request.people,
        )
        return SolverUpdate(solution=solution)

    def _drawn(self, request: SolveRequest, eyes_m: Eyes, reduction: int) -> Job:
        """Draw a solution's target pictures, and copy them for a refinement if the head is at rest."""
        state, plan = self.state, self.state.settings.plan
        job = drawn_job(
            state.predictor, state.content, eyes_m, time_ns=request.time_ns, reduction=reduction,
            trimmed=plan.enabled, before=self._windows.get(reduction), in_depth=plan.align,
        )  # fmt: skip
        self._kept = None
        if request.eyes_label == "rested" and not any(isinstance(v.picture, DrawnPicture) for v in job.views):
            views = tuple(TargetView(view.pixels.copy(), view.plane_from_picture) for view in job.views)
            job = self._kept = replace(job, targets=replace(job.targets, views=views))
        return job

    def _draw_flat(self, *, revision: int, time_ns: int) -> SolverUpdate:
        state, watch = self.state, Stopwatch()
        failed = False
        try:
            raster = self.stack.panel(self.stack.count // 2)
            middle = self._middle_m
            view = View(middle, 0, raster_from_stack(middle, raster), raster.width_px, raster.height_px)
            picture = state.content.render(view, time_ns=time_ns)
        except (Exception, SystemExit) as error:
            failed, missing = True, self._failed("content", error, expected=ContentFailure)
            if self._flat is not None:
                return SolverUpdate(missing=missing)
            picture = np.full((self.stack.height_px, self.stack.width_px, 4), 255, np.uint8)
        layers: U8 = flat_layers(picture, self.stack)
        if not failed:
            self._missing.pop("content", None)
            self._flat = SolutionKey(state.version, revision, None, episode=self._policy.episode)
        watch.lap("render")
        flat = Solution(next(self._numbers), layers, None, time_ns, stage_ms=watch.stage_ms)
        return SolverUpdate(flat=flat, missing=dict(self._missing))  # the model's fault is not over

    def _replan(self, eyes_m: Eyes | None) -> None:
        """Update the plan if the state or the set of eyes that can see the display has changed."""
        state, seeing = self.state, self.seeing if eyes_m is None else seeing_eyes(eyes_m, self.seeing)
        self.seeing = seeing
        made_for = (state.version, seeing)
        if made_for != self._planned_for:
            self._planned_for = made_for
            self.plan = make_plan(state.content.info, state.settings, seeing=seeing, measured=self.measured)

    def _failed(self, part: str, error: BaseException, *, expected: type[Exception]) -> dict[str, str]:
        self._missing[part] = str(error).splitlines()[0] if str(error) else type(error).__name__
        if isinstance(error, expected):
            log.warning("%s: %s", part, error)
        else:
            log.exception("%s", part)
        return dict(self._missing)
