"""The iterative reference solver: simultaneous algebraic reconstruction on the second branch of Malus' law.

Any stack of 2 to 8 panels. Each eye in turn corrects every panel by an equal share of its residual
(Andersen and Kak 1984; on polarization fields Lanman et al. 2011).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.clock import Stopwatch
from runtime.errors import ModelFailure
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.job import Job
from runtime.model.resample import target_from_source
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen, layer_pixels_from_seen
from runtime.records import F32, F64

ITERATIONS = 10


class SartPredictor(Predictor):
    """`sart`: always there, for any stack; float32 throughout, rounded at the end."""

    provider = "numpy"
    parameters = 0

    def __init__(self, stack: PanelStack, *, iterations: int = ITERATIONS, why: str = "") -> None:
        self.stack, self.iterations = stack, iterations
        self.name = f"sart ({why})" if why else "sart"
        # With two panels the sum can't leave [0, 2]; from two up the second branch starts at its middle.
        self._start = 1.5 / stack.count

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return (self.stack.panel(self.stack.count // 2),)

    def solve(self, job: Job) -> Prediction:
        watch = Stopwatch(*STAGES)
        stack = self.stack
        table = phase_from_intensity(np.arange(256, dtype=np.float32) / np.float32(255)).astype(np.float32)
        target = [cv2.LUT(np.ascontiguousarray(image[0][..., :3]), table) for image in job.arrays]
        shape = (stack.height_px, stack.width_px, 3)
        panels: list[NDArray[np.float32]] = [np.full(shape, self._start, np.float32) for _ in range(stack.count)]
        forward = [[self._panel_from_middle(eye, n) for n in range(stack.count)] for eye in job.eyes_m]
        back = [[np.linalg.inv(matrix) for matrix in matrices] for matrices in forward]
        watch.lap("prepare")
        for _ in range(self.iterations):
            for side in range(2):
                residual = target[side] - sum(_warp(p, m) for p, m in zip(panels, forward[side], strict=True))
                for n in range(stack.count):
                    panels[n] += _warp(residual, back[side][n]) / np.float32(stack.count)
                    np.clip(panels[n], 0, 1, out=panels[n])
        watch.lap("inference")
        layers = np.full((stack.count, stack.height_px, stack.width_px, 4), 255, np.uint8)
        for n, panel in enumerate(panels):
            if not np.isfinite(panel.sum()):
                raise ModelFailure("the solver diverged")
            layers[n, ..., :3] = np.rint(panel * 255)
        watch.lap("finish")
        return Prediction(layers, watch.stage_ms, self.iterations)

    def _panel_from_middle(self, eye_m: F64, index: int) -> F64:
        """3x3: a layer's pixels from the middle panel's, as an eye sees them in line; OpenCV's pixel centres."""
        source, target = self.rasters(eye_m)[0], self.stack.panel(index)
        matrix = target_from_source(eye_m, source=source, target=target)
        if self.stack.tilt is not None:
            matrix = layer_pixels_from_seen(target, coarse_layer_from_seen(self.stack, index, eye_m)) @ matrix
        to_corners = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
        to_centres = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
        return np.asarray(to_centres @ matrix @ to_corners, dtype=np.float64)


def _warp(image: F32, matrix: Any) -> Any:
    size, flags, edge = image.shape[1::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
    if matrix[2, 0] == 0.0 and matrix[2, 1] == 0.0:
        return cv2.warpAffine(image, matrix[:2] / matrix[2, 2], size, flags=flags, borderMode=edge)
    return cv2.warpPerspective(image, matrix, size, flags=flags, borderMode=edge)
