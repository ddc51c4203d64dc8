"""The unrolled solver: a network along the eyes' line, local corrections, and the centre panel in closed form.

Phases are fixed-point (sixteenths of an 8-bit code); outer panels are kept as the 8 bits that will be shown, so
that every correction sees what the eyes will see.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.errors import ModelFailure
from runtime.model.chain import ChainFrame, chain_frame, chain_modes
from runtime.model.predictor import Prediction, Predictor
from runtime.model.resample import resample, target_from_source
from runtime.model.session import ModelSession
from runtime.model.transfer import FULL, SUBCODE, phase_codes
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, U8

I16 = NDArray[np.int16]
NS_PER_MS = 1e6
OUTER = (0, 2)  # rear, front
START = 128  # of every panel: the middle of its range


class UnrolledPredictor(Predictor):
    """Models of `input_frame` chain: three evenly spaced panels, any pose."""

    def __init__(self, session: ModelSession, stack: PanelStack, *, tolerance_mm: float) -> None:
        self.session, self.stack = session, stack
        self.name, self.provider = session.contract.name, session.provider
        self.parameters = session.contract.parameters
        self.tolerance_mm = tolerance_mm
        self._layers = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return (self.stack.panel(1),)

    def predict(self, images: Sequence[Sequence[U8]], eyes_m: F64) -> Prediction:
        clock = _Stopwatch()
        contract = self.session.contract
        try:
            frame = chain_frame(eyes_m, self.stack, cell_px=contract.cell_px, reduction=contract.reduction)
        except ValueError as error:
            raise ModelFailure(str(error)) from None
        wanted = [self._phases(image[0]) for image in images]
        shape = wanted[0].shape
        outer = {n: np.full(shape, START, np.uint8) for n in OUTER}
        centre, residuals = close_centre(wanted, [np.full(shape, 2 * START, np.int16)] * 2)
        clock.lap("prepare")
        for step in contract.steps:
            if step.kind == "chain":
                self._chain(outer, residuals, frame, eyes_m, clock, step.size)
            else:
                self._sweep(outer, residuals, eyes_m, step.size)
            seen = [self._outer_sum(outer, eye_m) for eye_m in eyes_m]
            centre, residuals = close_centre(wanted, seen)
            clock.lap("finish")
        for n, layer in ((0, outer[0]), (1, centre), (2, outer[2])):
            cv2.cvtColor(layer, cv2.COLOR_RGB2RGBA, dst=self._layers[n])
        clock.lap("finish")
        return Prediction(self._layers, clock.stage_ms)

    def _phases(self, image: U8) -> I16:
        return cv2.LUT(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), phase_codes(self.session.contract.branch))

    def _outer_sum(self, outer: dict[int, U8], eye_m: F64) -> I16:
        """Rear plus front panel, as an eye sees them through the centre panel's pixels; 8-bit codes."""
        seen = [self._from(eye_m, outer[n], target=n) for n in OUTER]
        return cv2.add(seen[0], seen[1], dtype=cv2.CV_16S)

    def _from(self, eye_m: F64, image: U8, *, target: int) -> U8:
        """Panel `target`'s picture on the centre panel's pixels."""
        return self._between(eye_m, image, of=target, on=1)

    def _between(self, eye_m: F64, image: NDArray[Any], *, of: int, on: int) -> NDArray[Any]:
        matrix = target_from_source(eye_m, source=self.stack.panel(on), target=self.stack.panel(of))
        return resample(image, image_from_result=matrix, width_px=self.stack.width_px, height_px=self.stack.height_px)

    def _sweep(self, outer: dict[int, U8], residuals: Sequence[I16], eyes_m: F64, size: float) -> None:
        """A symmetric correction of the outer panels from both eyes' residuals."""
        for n in OUTER:
            back = [self._between(eye_m, r, of=1, on=n) for eye_m, r in zip(eyes_m, residuals, strict=True)]
            total = cv2.addWeighted(back[0], size / SUBCODE, back[1], size / SUBCODE, 0)
            outer[n] = cv2.add(outer[n], total, dtype=cv2.CV_8U)

    def _chain(
        self,
        outer: dict[int, U8],
        residuals: Sequence[I16],
        frame: ChainFrame,
        eyes_m: F64,
        clock: _Stopwatch,
        size: float,
    ) -> None:
        """The network's correction: what the outer panels must carry for the eyes to differ as they should."""
        reduction = self.session.contract.reduction
        half_size = (self.stack.width_px // reduction, self.stack.height_px // reduction)
        reduced_from_full = np.diag([1 / reduction, 1 / reduction, 1.0])
        seen = []
        for eye_m, residual in zip(eyes_m, residuals, strict=True):
            reduced = cv2.resize(residual, half_size, interpolation=cv2.INTER_AREA)
            t = (self.stack.x_m[1] - frame.x_m) / (eye_m[0] - frame.x_m)
            across = np.array([[1 - t, 0.0, eye_m[1] * t], [0.0, 1 - t, eye_m[2] * t], [0.0, 0.0, 1.0]])
            matrix = reduced_from_full @ self.stack.panel(1).raster_from_plane() @ across @ frame.plane_from_raster
            seen.append(resample(reduced, image_from_result=matrix, width_px=frame.width_px, height_px=frame.rows))
        difference = np.subtract(seen[1], seen[0], dtype=np.float32)
        difference *= 1 / FULL
        modes_out, spectrum, modes_in = chain_modes(frame.cells)
        clock.lap("prepare")
        answer = self.session.run(
            difference.reshape(frame.rows, frame.cells, -1),
            modes_out,
            spectrum,
            modes_in,
            np.array([self.tolerance_mm], np.float32),
            output_shape=(frame.rows, frame.cells + 1, 2 * frame.cell_px * 3),
        )
        clock.lap("inference")
        wave = np.rint(answer.reshape(frame.rows, -1, 3) * (FULL * size)).astype(np.int16)
        for n, sign in ((0, -1.0), (2, 1.0)):
            panel = self.stack.panel(n)
            t = (panel.x_m - frame.x_m) / (frame.middle_m[0] - frame.x_m)
            back = np.array(
                [
                    [1 / (1 - t), 0.0, -frame.middle_m[1] * t / (1 - t)],
                    [0.0, 1 / (1 - t), -frame.middle_m[2] * t / (1 - t)],
                    [0.0, 0.0, 1.0],
                ]
            )
            matrix = np.linalg.inv(frame.plane_from_raster) @ back @ panel.plane_from_raster()
            matrix[0, 2] += frame.cell_px  # the answer begins one parallax before the first column
            wide = resample(
                wave, image_from_result=matrix, width_px=self.stack.width_px, height_px=self.stack.height_px
            )
            codes = cv2.addWeighted(wide, sign / SUBCODE, wide, 0.0, 0.0)
            outer[n] = cv2.add(outer[n], codes, dtype=cv2.CV_8U)


def close_centre(wanted: Sequence[I16], outer_sums: Sequence[I16]) -> tuple[U8, list[I16]]:
    """The best centre panel for given outer panels, per pixel and in closed form, and what each eye still lacks.

    wanted: each eye's phase sum; outer_sums: rear plus front panel in 8-bit codes. Returns the centre panel's
    8-bit codes and each eye's residual; phases and residuals in sixteenths of a code.
    """
    needs = [w - (o << 4) for w, o in zip(wanted, outer_sums, strict=True)]
    mean = (needs[0] + needs[1] + SUBCODE) >> 5
    centre = np.clip(mean, 0, 255).astype(np.uint8)
    shown = centre.astype(np.int16) << 4
    return centre, [need - shown for need in needs]


class _Stopwatch:
    """Adds the time since the last lap to a named stage."""

    def __init__(self) -> None:
        self.stage_ms = {"prepare": 0.0, "inference": 0.0, "finish": 0.0}
        self._last_ns = perf_counter_ns()

    def lap(self, stage: str) -> None:
        now_ns = perf_counter_ns()
        self.stage_ms[stage] += (now_ns - self._last_ns) / NS_PER_MS
        self._last_ns = now_ns
