"""Decide whether the solver should compute a solution, draw the flat picture or do nothing.

This module uses no clock and does no I/O. Only the rest watch (`eyes.rest`), which receives the sensor's samples,
decides whether a head is at rest. Eyes labelled `rested` are solved for only once. Otherwise, whenever the eyes change
at all, a new solution is computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from runtime.clock import NS_PER_S
from runtime.plan.savings import Plan, selected_eyes
from runtime.records import F64, Effort, Eyes, EyesEstimate, SolveRequest

BLEND_S = 0.3  # duration of a blend to or from the flat picture

Kind = Literal["solve", "refine", "flat", "nothing"]


@dataclass(frozen=True, slots=True)
class SolutionKey:
    """The inputs of the latest solution or flat picture, which is outdated if they change."""

    state_version: int
    revision: int  # content revision
    eyes_m: Eyes | None  # (2, 3) eyes that the solution was computed for; None for a flat picture
    effort: Effort | None = None  # effort spent on the solution
    episode: int = 0  # number of the flat episode; during an episode, the flat picture's viewpoint does not change


@dataclass(frozen=True, slots=True)
class Decision:
    """The solver's next action."""

    kind: Kind
    eyes_m: Eyes | None = None  # (2, 3) eyes to solve for


class FramePolicy:
    """Decides the solver's next action, given a request and the keys of the existing pictures."""

    def __init__(self) -> None:
        self.episode = 0  # number of the current or latest flat episode
        self._flat_wanted = False
        self._flat_was_last = False

    def next_job(
        self,
        request: SolveRequest,
        *,
        plan: Plan | None,
        state_version: int,
        revision: int,
        solved: SolutionKey | None,
        flat: SolutionKey | None,
    ) -> Decision:
        """Decide what to do next for a request, given the run's and content's versions and results."""
        if request.flat_wanted and not self._flat_wanted:
            self.episode += 1
        self._flat_wanted = request.flat_wanted
        if request.paused and solved is not None:
            return Decision("nothing")
        present = (state_version, revision, self.episode)
        wants_flat = flat is None or (
            request.flat_wanted and (flat.state_version, flat.revision, flat.episode) != present
        )
        eyes_m = self._eyes_to_solve(request, plan, state_version=state_version, revision=revision, solved=solved)
        if wants_flat and (eyes_m is None or flat is None or not self._flat_was_last):
            self._flat_was_last = True
            return Decision("flat")
        self._flat_was_last = False
        if eyes_m is not None:
            return Decision("solve", eyes_m)
        if request.eyes_m is not None and solved is not None and _is_more(request.refined_to, solved.effort):
            return Decision("refine", solved.eyes_m)
        return Decision("nothing")

    def _eyes_to_solve(
        self, request: SolveRequest, plan: Plan | None, *, state_version: int, revision: int, solved: SolutionKey | None
    ) -> F64 | None:
        """Choose the eyes (2, 3) to solve for, or None if the latest solution is still valid or no eyes are known."""
        if request.eyes_m is None:
            return None
        eyes_m = request.eyes_m if plan is None else selected_eyes(request.eyes_m, plan.eyes)
        if solved is None or (solved.state_version, solved.revision) != (state_version, revision):
            return eyes_m
        assert solved.eyes_m is not None
        return None if np.array_equal(solved.eyes_m, eyes_m) else eyes_m


def _is_more(effort: Effort | None, done: Effort | None) -> bool:
    """Return True if `effort` uses a finer raster than `done`, or more steps on the same raster. An effort that
    continues a solution is no more than one on another raster, because it was chosen for a solution that has been
    replaced since, and the new solution's pictures are too coarse to continue with.
    """
    if effort is None or done is None:
        return False
    if effort.continued_from is not None and effort.reduction != done.reduction:
        return False
    return (-effort.reduction, effort.focus, effort.steps) > (-done.reduction, done.focus, done.steps)


def wants_flat(eyes: EyesEstimate, *, flat_asked: bool, flatness: float) -> bool:
    """Return True if the flat picture is shown, with weight `flatness`, or may be needed soon."""
    return flat_asked or flatness > 0.0 or eyes.label in ("held", "none")


@dataclass(slots=True)
class Flatness:
    """Fades the flat picture in or out by changing its mixing weight at a constant rate."""

    value: float = 1.0  # mixing weight, from 0 (only the solution) to 1 (only the flat picture)
    since_ns: int = -1  # when `toward` was last called; -1 before the first call

    def toward(self, target: float, *, now_ns: int) -> float:
        """Move `value` towards `target`, in proportion to the time since the last call, and return it."""
        elapsed_s = 0.0 if self.since_ns < 0 else (now_ns - self.since_ns) / NS_PER_S
        self.since_ns = now_ns
        step = elapsed_s / BLEND_S
        self.value = max(target, self.value - step) if target < self.value else min(target, self.value + step)
        return self.value
