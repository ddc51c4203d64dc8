"""A scene, a model and a retina on one small stack: what the sweeps of the report drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from runtime.config import ModelSettings
from runtime.errors import ModelFailure
from runtime.model.predictor import Predictor, load_predictor
from runtime.optics.carried import expected_psnrs_db
from runtime.optics.pupil import PUPIL_SIGMA_MM
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for
from runtime.records import F64, U8
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

    def layers(self, eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM) -> U8 | None:
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

    def seen_db(self, eyes_m: F64, layers: U8, *, sigmas_mm: Sequence[float] = (0.0, 1.0)) -> dict[float, float]:
        """Displayed PSNR of both eyes, expected for each uncertainty of theirs in millimetres; 0: exact.

        NaN where an eye sees nothing of the panels, or would with such an error.
        """
        drawn, fov_deg = self.pictures(eyes_m)
        try:
            return expected_psnrs_db(layers, drawn, self.stack, eyes_m=eyes_m, fov_deg=fov_deg, sigmas_mm=sigmas_mm)
        except ValueError:
            return dict.fromkeys(sigmas_mm, math.nan)

    def fov_deg(self, eye_m: ArrayLike) -> float:
        """A field of view that the panels fill, so that every distance is judged at the panels' own resolution."""
        distance_m = float(np.linalg.norm(np.asarray(eye_m, dtype=np.float64)))
        return min(100.0, math.degrees(2 * math.atan(self.stack.width_m / 2 / distance_m)))
