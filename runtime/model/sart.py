"""SART (simultaneous algebraic reconstruction technique) on one branch of Malus' law, for comparison.

The technique (Andersen and Kak 1984) is the published solver for polarization fields (Lanman et al. 2011). This
implementation supports any number of panels and views. Each iteration corrects all panels together, by equal
shares of all views' residual phases. A panel without colour filters gets the mean correction of the three channels. The
relaxation factor is the best value found by trial and error.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.clock import Stopwatch
from runtime.errors import ModelFailure
from runtime.kernels import FULL
from runtime.model.base import STAGES, ModelFacts, Prediction, Predictor
from runtime.model.geometry import panel_from_middle
from runtime.model.job import Job
from runtime.model.targets import target_table
from runtime.model.warp import picture_on
from runtime.optics.malus import rest_value
from runtime.optics.stack import PanelStack, between_pixel_centres
from runtime.records import F32, F64

ITERATIONS = 10
RELAXATION = 1.7  # factor for the views' mean residual, found by trial and error; factors of 2 or more diverge


class SartPredictor(Predictor):
    """The model `sart`, which computes in float32 for any stack and rounds the result to 8 bits."""

    facts = ModelFacts("sart", "numpy")

    def __init__(self, stack: PanelStack, *, iterations: int = ITERATIONS) -> None:
        self.stack, self.iterations = stack, iterations

    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        watch, stack = watch or Stopwatch(*STAGES), self.stack
        table = np.ascontiguousarray(target_table(stack.count)[:, 0] / np.float32(FULL))
        middle, size, rest = stack.panel(stack.count // 2), (stack.height_px, stack.width_px), rest_value(stack.count)
        pictures = [
            picture_on(view, middle, middle_from_result=np.eye(3), edge=cv2.BORDER_REPLICATE, size=size)
            for view in job.views
        ]
        targets = [cv2.LUT(np.ascontiguousarray(picture[..., :3]), table) for picture in pictures]
        panels: list[NDArray[np.float32]] = [np.full((*size, 3), rest, np.float32) for _ in range(stack.count)]
        forward = [[self._panel_from_middle(eye, n) for n in range(stack.count)] for eye in job.eyes_m]
        back = [[np.linalg.inv(matrix) for matrix in matrices] for matrices in forward]
        share = np.float32(RELAXATION / (len(targets) * stack.count))
        watch.lap("prepare")
        for _ in range(self.iterations):
            residuals = [
                target - sum(_warp(panel, matrix) for panel, matrix in zip(panels, matrices, strict=True))
                for target, matrices in zip(targets, forward, strict=True)
            ]
            for n, panel in enumerate(panels):
                correction = sum(
                    _warp(residual, matrices[n]) for residual, matrices in zip(residuals, back, strict=True)
                )
                panel += share * (correction.mean(axis=2, keepdims=True) if stack.is_grey(n) else correction)
                np.clip(panel, 0, 1, out=panel)
        watch.lap("inference")
        layers = np.full((stack.count, stack.height_px, stack.width_px, 4), 255, np.uint8)
        for n, panel in enumerate(panels):
            if not np.isfinite(panel.sum()):
                raise ModelFailure("the solver diverged")
            layers[n, ..., :3] = np.rint(panel * 255)
        watch.lap("finish")
        floats = np.stack(panels) if job.floats else None
        return Prediction(layers, watch.stage_ms, job.savings, floats, self.iterations)

    def _panel_from_middle(self, eye_m: F64, index: int) -> F64:
        """Return the 3x3 homography from middle-panel to layer pixels along an eye's rays, as OpenCV counts."""
        rasters = [self.stack.panel(n) for n in range(self.stack.count)]
        return between_pixel_centres(panel_from_middle(self.stack, rasters, eye_m, index))


def _warp(image: F32, matrix: Any) -> Any:
    size, flags, edge = image.shape[1::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
    if matrix[2, 0] == 0.0 and matrix[2, 1] == 0.0:
        return cv2.warpAffine(image, matrix[:2] / matrix[2, 2], size, flags=flags, borderMode=edge)
    return cv2.warpPerspective(image, matrix, size, flags=flags, borderMode=edge)
