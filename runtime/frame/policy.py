"""Decisions on what to solve and show (flat, solved, reuse): pure, without clock or I/O.

Stillness is decided in one place, by the rest watch on the sensor's samples (`eyes.rest`): here, eyes labelled
`rested` are solved for once. Whatever else moves them is solved for anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from runtime.clock import NS_PER_S
from runtime.plan.savings import Plan, selected_eyes
from runtime.records import F64, Effort, EyesEstimate, SolveRequest

BLEND_S = 0.3  # in which the picture goes over to the flat one, or back

Kind = Literal["solve", "refine", "flat", "nothing"]


@dataclass(frozen=True, slots=True)
class SolutionKey:
    """Inputs that the newest solution, or flat picture, was made from."""

    state_version: int
    revision: int  # of the content
    eyes_m: F64 | None  # (2, 3) as they were solved for; None: flat
    effort: Effort | None = None  # of the solution
    episode: int = 0  # of the flat picture: it keeps its place of drawing as long as it is wanted


@dataclass(frozen=True, slots=True)
class Decision:
    """What the solver does next."""

    kind: Kind
    eyes_m: F64 | None = None  # (2, 3) to solve for


class FramePolicy:
    """Decides between solving, drawing the flat picture and doing nothing, from what is there already."""

    def __init__(self) -> None:
        self.episode = 0  # number of the present (or last) time that the flat picture was wanted
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
        """plan: allowed savings; solved, flat: what there is; revision: the content's at `request.time_ns`."""
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
        """None: the newest solution will do, or there is nobody to solve for."""
        if request.eyes_m is None:
            return None
        eyes_m = request.eyes_m if plan is None else selected_eyes(request.eyes_m, plan.eyes)
        if solved is None or (solved.state_version, solved.revision) != (state_version, revision):
            return eyes_m
        assert solved.eyes_m is not None
        return None if (solved.eyes_m == eyes_m).all() else eyes_m


def _is_more(effort: Effort | None, done: Effort | None) -> bool:
    """Whether an effort adds to one that has been made: a finer raster, or further steps."""
    if effort is None or done is None:
        return False
    return (-effort.reduction, effort.steps) > (-done.reduction, done.steps)


def wants_flat(eyes: EyesEstimate, *, flat_asked: bool, flatness: float) -> bool:
    """Whether the flat picture is shown or will soon be: it is made before it is needed."""
    return flat_asked or flatness > 0.0 or eyes.label in ("held", "none")


@dataclass(slots=True)
class Flatness:
    """Mixing weight of the flat picture, 0 to 1, which moves at a constant rate."""

    value: float = 1.0
    since_ns: int = -1

    def toward(self, target: float, *, now_ns: int) -> float:
        """One step towards 0 or 1."""
        elapsed_s = 0.0 if self.since_ns < 0 else (now_ns - self.since_ns) / NS_PER_S
        self.since_ns = now_ns
        step = elapsed_s / BLEND_S
        self.value = max(target, self.value - step) if target < self.value else min(target, self.value + step)
        return self.value
