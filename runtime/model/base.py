"""What every model answers: which pictures it wants drawn, and the layers it makes of a job."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from runtime.model.job import Job
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, U8, Layers, pixels_of

if TYPE_CHECKING:
    from runtime.model.device import SolverBackend


STAGES = ("prepare", "inference", "finish")  # inference: the network alone


@dataclass(frozen=True, slots=True)
class Prediction:
    """The layers for a job, and what they took."""

    made: Layers  # (N, height_px, width_px, 4) RGBA, rear to front; an array is the predictor's until its next call
    stage_ms: dict[str, float] = field(default_factory=dict)  # by STAGES
    steps: int = 1  # of the model, that were done

    @property
    def layers(self) -> U8:
        """What was made, as an array. Raises ContextLost."""
        return pixels_of(self.made)


class Predictor(ABC):
    """A job in, N layers out. One thread uses it."""

    name: str
    provider: str
    parameters: int
    precision: str = "fp32"  # the network's weights and arithmetic
    stack: PanelStack
    backend: str = "cpu"  # what does all that surrounds the network at present
    fell_back: tuple[str, ...] = ()  # nodes of the network that run on another provider than the wished one
    needs_rasters: bool = True  # whether still pictures are warped for it; else it looks along their own rays
    black_beside: bool = False  # whether those end in black, not in their repeated edge
    trims: bool = False  # whether it solves a part of the panels, or one channel (`trim`)

    def reads_textures_of(self, context: object) -> bool:
        """Whether `solve` takes pictures that were left in textures of a GL context (`DrawnPicture`)."""
        return False

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        """The same model for other panels of its kind, to measure backends; None: it has one backend."""
        return None

    def set_backend(self, backend: SolverBackend) -> None:  # noqa: B027 - most have one
        """Run everything but the network on another backend from the next call on (solver's thread)."""

    @abstractmethod
    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        """The rasters that each eye's picture must be drawn on, for eyes (2, 3), frame `stack`."""

    @abstractmethod
    def solve(self, job: Job) -> Prediction:
        """The layers of a job.

        Raises ModelFailure where inference fails or does not answer with finite numbers; of these EyesNotServed where
        the model has no picture for two eyes like these.
        """

    def warm_up(self, eyes_m: F64) -> None:
        """Solve once for grey pictures, so that the first frame does not pay for allocation."""
        rasters = self.rasters(eyes_m)
        grey = [np.full((raster.height_px, raster.width_px, 4), 128, np.uint8) for raster in rasters]
        self.solve(Job([grey, grey], eyes_m))

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release threads and sessions. May be called twice."""
