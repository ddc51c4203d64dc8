"""Interface of the models, which compute layers from a job."""

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


STAGES = ("prepare", "inference", "finish", "step")  # inference: only the network; step: all updates of the panels


@dataclass(frozen=True, slots=True)
class Prediction:
    """Layers that a model computed for a job, and the work that the computation took."""

    layers: U8  # (N, height_px, width_px, 4) RGBA, rear to front, in the size of the job's stack; read-only
    stage_ms: dict[str, float] = field(default_factory=dict)  # time of each of STAGES
    savings: Savings = field(default_factory=Savings)
    steps: int = 0  # updates of all panels, including the updates of earlier solutions that were continued
    continued_from: int | None = None  # updates of earlier solutions among `steps`; None: no solution was continued


class Predictor(ABC):
    """Model that computes the layers of a job. Only one thread may use a predictor."""

    name: str
    provider: str
    parameters: int
    precision: str = "fp32"  # precision of the network's weights and arithmetic
    stack: PanelStack  # the display's geometry
    backend: str = "cpu"  # device for everything except the network
    trims: bool = False  # True if the model can solve a window of the panels, or a single channel (`trim`)
    reductions: tuple[int, ...] = (1,)  # supported rasters, as divisors of the display's rows and columns
    steps: int = 0  # updates of all panels in a solution
    refined_steps: int = 0  # number of updates up to which a solution can be continued
    warmed_ms: Mapping[int, Mapping[str, float]] = MappingProxyType({1: {}})  # stage times of `warm_up`, by reduction

    def reads_textures_of(self, context: object) -> bool:
        """Return True if `solve` accepts pictures in textures of this OpenGL context (`DrawnPicture`)."""
        return False

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        """Return a copy of the model for panels of another size, which is used to time backends.

        The result is None if the model runs on only one backend.
        """
        return None

    def set_backend(self, backend: SolverBackend) -> None:  # noqa: B027 - most have one
        """Select the backend that runs everything except the network from the next call on.

        Only the thread that solves may call this method.
        """

    @abstractmethod
    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        """Compute the layers of a job.

        Args:
            watch: Stopwatch to which the time of each stage is added.

        Raises:
            ModelFailure: Inference failed or returned numbers that are not finite.
            EyesNotServed: The model does not support the job's eye positions.
        """

    def warm_up(self, eyes_m: F64) -> None:
        """Solve grey pictures in one step on every raster, which allocates all memory before the first frame.

        The times of the stages are kept in `warmed_ms`.

        Args:
            eyes_m: (2, 3) left and right eye in frame `stack`.
        """
        measured = {}
        for reduction in self.reductions:
            job = replace(grey_job(eyes_m, self.stack.reduced(reduction)), steps=1)
            self.solve(job)
            runs = [self.solve(job).stage_ms for _ in range(min(reduction, 3))]  # other processes may delay a run
            measured[reduction] = {stage: min(run[stage] for run in runs) for stage in runs[0]}
        self.warmed_ms = measured

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release threads and sessions. The method may be called more than once."""
