"""Interface of every model: it turns a job into layers."""

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


STAGES = ("prepare", "inference", "finish", "step")  # inference: the network alone; step: all updates of the panels


@dataclass(frozen=True, slots=True)
class Prediction:
    """Layers computed for a job, and the work spent on them."""

    layers: U8  # (N, height_px, width_px, 4) RGBA, rear to front, as large as the job's stack; read-only
    stage_ms: dict[str, float] = field(default_factory=dict)  # time of each of STAGES
    savings: Savings = field(default_factory=Savings)
    steps: int = 0  # updates of all panels, including those of the solutions that it continues
    continued_from: int | None = None  # how many of `steps` an earlier solution had already done; None: not continued


class Predictor(ABC):
    """A model that computes the N layers of a job. Only one thread uses it."""

    name: str
    provider: str
    parameters: int
    precision: str = "fp32"  # precision of the network's weights and arithmetic
    stack: PanelStack  # the display's geometry
    backend: str = "cpu"  # device for everything except the network
    trims: bool = False  # can solve a window of the panels, or a single channel (`trim`)
    reductions: tuple[int, ...] = (1,)  # rasters it solves on, as divisors of the display's rows and columns
    steps: int = 0  # updates of all panels in a solution
    refined_steps: int = 0  # number of updates up to which a solution can be continued
    warmed_ms: Mapping[int, Mapping[str, float]] = MappingProxyType({1: {}})  # stage times of `warm_up`, by reduction

    def reads_textures_of(self, context: object) -> bool:
        """Return True if `solve` can read pictures in textures of this GL context (`DrawnPicture`)."""
        return False

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        """Return a copy for panels of another size, to time backends; None if there is only one backend."""
        return None

    def set_backend(self, backend: SolverBackend) -> None:  # noqa: B027 - most have one
        """Run everything except the network on another backend from the next call on (solver's thread)."""

    @abstractmethod
    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        """Compute the layers of a job.

        watch: stopwatch to which the stages' times are added.
        Raises ModelFailure if inference fails or returns numbers that are not finite, and its subclass
        EyesNotServed if the model does not support eyes at these positions.
        """

    def warm_up(self, eyes_m: F64) -> None:
        """Solve grey pictures in one step on every raster, so that the first frame allocates nothing."""
        measured = {}
        for reduction in self.reductions:
            job = replace(grey_job(eyes_m, self.stack.reduced(reduction)), steps=1)
            self.solve(job)
            runs = [self.solve(job).stage_ms for _ in range(min(reduction, 3))]  # other work may delay one run
            measured[reduction] = {stage: min(run[stage] for run in runs) for stage in runs[0]}
        self.warmed_ms = measured

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release threads and sessions. May be called twice."""
