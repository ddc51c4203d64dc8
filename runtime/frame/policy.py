"""Decide what to solve and show (flat, solved or reused), without a clock or I/O.

Only the rest watch (`eyes.rest`), which sees the sensor's samples, decides whether a head is still. Eyes labelled
`rested` are solved for once; any other change of position requires a new solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from runtime.clock import NS_PER_S
from runtime.plan.savings import Plan, selected_eyes
from runtime.records import F64, Effort, EyesEstimate, SolveRequest

BLEND_S = 0.3  # duration of the blend to the flat picture and back

Kind = Literal["solve", "refine", "flat", "nothing"]


@dataclass(frozen=True, slots=True)
class SolutionKey:
    """Inputs of the newest solution or flat picture, by which it is recognized as outdated."""

    state_version: int
    revision: int  # the content's revision
    eyes_m: F64 | None  # (2, 3) eyes that it was solved for; None: a flat picture
    effort: Effort | None = None  # the solution's effort
    episode: int = 0  # number of the flat episode, in which the flat picture keeps one viewpoint


@dataclass(frozen=True, slots=True)
class Decision:
    """The solver's next action."""

    kind: Kind
    eyes_m: F64 | None = None  # (2, 3) eyes to solve for


class FramePolicy:
    """Decides between solving, drawing the flat picture and doing nothing, given the existing pictures."""

    def __init__(self) -> None:
        self.episode = 0  # number of the current or last flat episode
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
        """Decide what the solver does next.

        plan: savings in force; revision: the content's at `request.time_ns`; solved, flat: keys of the newest results.
        """
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
        """Return the eyes (2, 3) to solve for; None if the newest solution is valid or no eyes are known."""
        if request.eyes_m is None:
            return None
        eyes_m = request.eyes_m if plan is None else selected_eyes(request.eyes_m, plan.eyes)
        if solved is None or (solved.state_version, solved.revision) != (state_version, revision):
            return eyes_m
        assert solved.eyes_m is not None
        return None if (solved.eyes_m == eyes_m).all() else eyes_m


def _is_more(effort: Effort | None, done: Effort | None) -> bool:
    """Return True if `effort` exceeds the effort already `done`, by a finer raster or more steps."""
    if effort is None or done is None:
        return False
    return (-effort.reduction, effort.steps) > (-done.reduction, done.steps)


def wants_flat(eyes: EyesEstimate, *, flat_asked: bool, flatness: float) -> bool:
    """Return True if the flat picture is shown or soon will be, so that it is ready in time."""
    return flat_asked or flatness > 0.0 or eyes.label in ("held", "none")


@dataclass(slots=True)
class Flatness:
    """Mixing weight of the flat picture, 0 to 1, which changes at a constant rate."""

    value: float = 1.0
    since_ns: int = -1

    def toward(self, target: float, *, now_ns: int) -> float:
        """Move `value` towards 0 or 1 according to the time since the last call, and return it."""
        elapsed_s = 0.0 if self.since_ns < 0 else (now_ns - self.since_ns) / NS_PER_S
        self.since_ns = now_ns
        step = elapsed_s / BLEND_S
        self.value = max(target, self.value - step) if target < self.value else min(target, self.value + step)
        return self.value
