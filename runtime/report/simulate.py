"""A scene, a model and a retina on one small stack: what the sweeps of the report drive."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from runtime.config import ModelSettings
from runtime.errors import ModelFailure
from runtime.model.predictor import Predictor, load_predictor
from runtime.optics.carried import intensities
from runtime.optics.pupil import POINT_MM
from runtime.optics.quality import psnr_db, squared_error
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for
from runtime.records import F64, U8
from runtime.report.eyesight import single_psnr_db
from runtime.report.pairs import Painter


class Simulation:
    """Draws what the eyes should see, predicts the layers, and looks at them from anywhere."""

    def __init__(self, scene: str, stack: PanelStack, *, model: str, settings: ModelSettings | None = None) -> None:
        """Raises InputError, MissingPart."""
        self.stack = stack
        self.predictor: Predictor = load_predictor(model, stack, settings)
        self.painter = Painter(scene, stack)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.painter.__exit__()
        self.predictor.close()

    def layers(self, eyes_m: F64, *, eye_sigma_mm: float = POINT_MM) -> U8 | None:
        """Layers for two eyes, drawn straight into the model's rasters as the daemon does; None: it refuses them."""
        images = drawn_for(self.predictor, self.painter.content, eyes_m, time_ns=0)
        try:
            return np.array(self.predictor.predict(images, eyes_m, eye_sigma_mm=eye_sigma_mm).layers)
        except ModelFailure:
            return None

    def pictures(self, eyes_m: F64) -> tuple[list[U8], float]:
        """What eyes (2, 3) should see, and the field of view of these pictures: both eyes' own, filled by the panel."""
        fov_deg = max(self.fov_deg(eye) for eye in eyes_m)
        size = {"width_px": self.stack.width_px, "height_px": self.stack.height_px}
        return [self.painter.image(eye, **size, fov_deg=fov_deg) for eye in eyes_m], fov_deg

    def psnr_db(self, eye_m: ArrayLike, layers: U8) -> float:
        """Displayed PSNR of one eye over the panel. NaN where no ray crosses every panel."""
        fov_deg = self.fov_deg(eye_m)
        wanted = self.painter.image(
            eye_m, width_px=self.stack.width_px, height_px=self.stack.height_px, fov_deg=fov_deg
        )
        return single_psnr_db(eye_m, layers, self.stack, wanted=wanted, fov_deg=fov_deg)

    def pooled_db(self, eyes_m: F64, layers: U8) -> float:
        """One mean squared error over both eyes' counted rays. NaN where there is none."""
        total, count = 0.0, 0
        for eye in eyes_m:
            fov_deg = self.fov_deg(eye)
            size = {"width_px": self.stack.width_px, "height_px": self.stack.height_px}
            wanted = self.painter.image(eye, **size, fov_deg=fov_deg)
            retina = seen_by(eye, layers, self.stack, fov_deg=fov_deg)
            squared, counted = squared_error(retina.image, intensities(wanted), retina.mask)
            total, count = total + squared, count + counted
        return psnr_db(total / count) if count else math.nan

    def fov_deg(self, eye_m: ArrayLike) -> float:
        """A field of view that the panels fill, so that every distance is judged at the panels' own resolution."""
        distance_m = float(np.linalg.norm(np.asarray(eye_m, dtype=np.float64)))
        return min(100.0, math.degrees(2 * math.atan(self.stack.width_m / 2 / distance_m)))
