"""What every model answers: which pictures it wants drawn, and the layers it makes of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from runtime.optics.pupil import PUPIL_SIGMA_MM
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, U8, Layers, pixels_of

if TYPE_CHECKING:
    from runtime.model.schedule import Backend


@dataclass(frozen=True, slots=True)
class Prediction:
    """The layers for two eyes, and what they took."""

    made: Layers  # (N, height_px, width_px, 4) RGBA, rear to front; an array is the predictor's until its next call
    stage_ms: dict[str, float] = field(default_factory=dict)  # prepare, inference (the network alone), finish

    @property
    def layers(self) -> U8:
        """What was made, as an array. Raises ContextLost."""
        return pixels_of(self.made)


class Predictor(ABC):
    """Two pictures in, N layers out. One thread uses it."""

    name: str
    provider: str
    parameters: int
    stack: PanelStack
    backend: str = "opencv"  # what does all that surrounds the network at present
    fell_back: tuple[str, ...] = ()  # nodes of the network that run on another provider than the wished one
    channels: int = 3  # that the last pictures were solved in: one, where grey ones may be

    def reads_textures_of(self, context: object) -> bool:
        """Whether `predict` takes pictures that were left in textures of a GL context (`DrawnPicture`)."""
        return False

    def on_panels(self, stack: PanelStack) -> Predictor | None:
        """The same model for other panels of the same kind, to measure backends with; None: it has one backend."""
        return None

    def surround_with(self, backend: Backend) -> None:  # noqa: B027 - most have one backend
        """Have what surrounds the network done in another way from the next call on. On the thread that predicts."""

    @abstractmethod
    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        """The rasters that each eye's picture must be drawn on, for eyes (2, 3), frame `stack`."""

    @property
    def interpolation(self) -> str:
        """How still pictures are to be warped for it: `linear`, `finer` or `cubic` (`Contract.interpolation`)."""
        return "linear"

    @property
    def pre_emphasis(self) -> float:
        """How strongly it sharpens pictures against the blur of interpolation (`transfer.pre_emphasised`)."""
        return 0.0

    @property
    def black_beside(self) -> bool:
        """Whether still pictures end in black, not in their repeated edge."""
        return False

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        """Rows and columns of each raster that `predict` will look at: all of them, where it doesn't know better."""
        return tuple((slice(0, raster.height_px), slice(0, raster.width_px)) for raster in self.rasters(eyes_m))

    @abstractmethod
    def predict(
        self, images: Sequence[Sequence[U8]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        """Layers for `images[eye][raster]`, (h, w, 4) RGBA, left eye first, drawn on `rasters(eyes_m)`.

        eye_sigma_mm: standard deviation, an axis, of where light enters the eyes, common to both, to the right and
        up; 0 asks for two points.

        Raises ModelFailure where inference fails or does not answer with finite numbers; of these EyesNotServed where
        the model has no picture for two eyes like these.
        """

    @property
    def refines(self) -> bool:
        """Whether `refine` may follow the last call of `predict`."""
        return False

    def refine(
        self, images: Sequence[Sequence[U8]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        """Layers for images that differ a little from those of the last call, for the same eyes: its panels, changed by
        the last steps alone. Raises ModelFailure."""
        raise NotImplementedError(f"{self.name} has no steps to do again")

    def warm_up(self, eyes_m: F64) -> None:
        """Run once on grey pictures, so that the first frame does not pay for allocation."""
        rasters = self.rasters(eyes_m)
        grey = [np.full((raster.height_px, raster.width_px, 4), 128, np.uint8) for raster in rasters]
        self.predict([grey, grey], eyes_m)

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release threads and sessions. May be called twice."""
