"""Interface for models, which compute layers from a job."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from runtime.clock import Stopwatch
from runtime.model.job import Job, Savings, grey_job
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, SOLVING_STAGES, U8

if TYPE_CHECKING:
    from runtime.model.buffers import LayerSlots
    from runtime.model.device import SolverBackend


STAGES = SOLVING_STAGES[1:]


TRIAL_M, TRIAL_ROOM_M = 0.6, 0.5  # the eyes' minimum distances from the origin and from the front panel
TRIAL_HALF_M = 0.031  # half the distance between the eyes


def trial_eyes_m(stack: PanelStack) -> F64:
    """Return (2, 3) eyes for warm-up and timing, a usual distance in front of all panels."""
    distance_m = max(TRIAL_M, max(stack.x_m) + TRIAL_ROOM_M)
    return np.array([[distance_m, -TRIAL_HALF_M, 0.0], [distance_m, TRIAL_HALF_M, 0.0]])


@dataclass(frozen=True, slots=True)
class Prediction:
    """The layers that a model computed for a job, and the work done to compute them."""

    layers: U8  # (N, height_px, width_px, 4) RGBA, rear to front, sized like the job's stack; read-only
    stage_ms: dict[str, float] = field(default_factory=dict)  # time taken by each of STAGES
    savings: Savings = field(default_factory=Savings)
    floats: F32 | None = None  # (N, height_px, width_px, 3) in [0, 1], the layers before rounding; None: not requested
    steps: int = 0  # updates of all panels, including those made by earlier solutions that were continued
    continued_from: int | None = None  # how many of `steps` earlier solutions made; None: no solution was continued


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Properties of a model, on any device and with panels of any size."""

    name: str  # as shown to the user
    provider: str
    parameters: int = 0
    precision: str = "fp32"  # precision of the network's weights and arithmetic
    has_devices: bool = False  # True if the device can be chosen (`Predictor.bound`)
    trims: bool = False  # True if the model can solve just a window or a single channel (`trim`)
    reductions: tuple[int, ...] = (1,)  # supported rasters, given as divisors of the display's rows and columns
    steps: int = 0  # updates of all panels in a full solution
    refined_steps: int = 0  # total number of updates that a continued solution can reach


class Predictor(ABC):
    """Model that computes the layers for a job. A predictor may be used by only one thread."""

    facts: ModelFacts
    stack: PanelStack  # the display's geometry
    backend: str = "cpu"  # device that runs everything except the network

    def reads_textures_of(self, context: object) -> bool:
        """Return True if `solve` accepts pictures held in this OpenGL context's textures (`DrawnPicture`)."""
        return False

    def name_with(self, views: int) -> str:
        """Return the model's name, with a note if its network does not serve this many views."""
        return self.facts.name

    def bound(
        self, *, backend: SolverBackend | None = None, stack: PanelStack | None = None, slots: LayerSlots | None = None
    ) -> Predictor:
        """Return the model with another device, panels of another size, or memory shared with another
        process for its layers. A network is shared. A model without a choice of devices returns itself.
        """
        return self

    @abstractmethod
    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        """Compute the layers for a job, and add each stage's time to `watch`. Raises ModelFailure if
        inference failed or is not finite, and EyesNotServed for unsupported eye positions.
        """

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release threads and sessions. May be called more than once."""


def warm_up(predictor: Predictor) -> dict[int, dict[str, float]]:
    """Solve grey pictures in one step on every raster, to allocate memory. Return stage times by raster."""
    measured, eyes_m = {}, trial_eyes_m(predictor.stack)
    for reduction in predictor.facts.reductions:
        job = replace(grey_job(eyes_m, predictor.stack.reduced(reduction)), steps=1)
        predictor.solve(job)
        runs = [predictor.solve(job).stage_ms for _ in range(min(reduction, 3))]  # other processes may delay a run
        measured[reduction] = {stage: min(run[stage] for run in runs) for stage in runs[0]}
    return measured
