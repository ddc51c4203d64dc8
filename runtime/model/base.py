"""Interface of every model: a job in, layers out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

from runtime.clock import Stopwatch
from runtime.model.job import Job, Savings, grey_job
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

if TYPE_CHECKING:
    from runtime.model.device import SolverBackend


STAGES = ("prepare", "inference", "finish", "step")  # inference: the network alone; step: all updates of panels


@dataclass(frozen=True, slots=True)
class Prediction:
    """The layers of a job, and their cost."""

    layers: U8  # (N, height_px, width_px, 4) RGBA, rear to front, of the job's stack; read-only
    stage_ms: dict[str, float] = field(default_factory=dict)  # by STAGES
    savings: Savings = field(default_factory=Savings)
    steps: int = 0  # updates of all panels, of this and of the solutions that it continues
    continued_from: int | None = None  # those of them that the solution before had; None: it was not continued


class Predictor(ABC):
    """A job in, N layers out. One thread uses it."""

    name: str
    provider: str
    parameters: int
    precision: str = "fp32"  # the network's weights and arithmetic
    stack: PanelStack  # the display's
    backend: str = "cpu"  # device for everything except the network
    trims: bool = False  # whether it solves a window of the panels, or one channel (`trim`)
    reductions: tuple[int, ...] = (1,)  # rasters it solves on: this many times fewer rows and columns than the display
    steps: int = 0  # updates of all panels that a solution has
    refined_steps: int = 0  # up to which a solution can be continued
    warmed_ms: Mapping[int, Mapping[str, float]] = MappingProxyType({1: {}})  # stage times of `warm_up`, by reduction

    def reads_textures_of(self, context: object) -> bool:
        """Return True if `solve` reads pictures in textures of a GL context (`DrawnPicture`)."""
        return False

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        """Copy of the model for other panels of its kind, to time backends; None: it has one backend."""
        return None

    def set_backend(self, backend: SolverBackend) -> None:  # noqa: B027 - most have one
        """Run everything except the network on another backend from the next call on (solver's thread)."""

    @abstractmethod
    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        """Compute the layers of a job. watch: its stages are added to.

        Raises ModelFailure where inference fails or yields numbers that are not finite; of these EyesNotServed where
        the model has no picture for two eyes like these.
        """

    def warm_up(self, eyes_m: F64) -> None:
        """Solve grey pictures with one step on every raster, so that the first frame does not pay for allocation."""
        measured = {}
        for reduction in self.reductions:
            job = replace(grey_job(eyes_m, self.stack.reduced(reduction)), steps=1)
            self.solve(job)
            runs = [self.solve(job).stage_ms for _ in range(min(reduction, 3))]  # other work delays some of them
            measured[reduction] = {stage: min(run[stage] for run in runs) for stage in runs[0]}
        self.warmed_ms = measured

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release threads and sessions. May be called twice."""
