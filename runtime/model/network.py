"""Whole-picture networks: eye pictures on panel rasters in, panel values out (the published U-Net, and its like)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.errors import InputError, ModelFailure
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.job import Job
from runtime.model.resample import buffer, resample, target_from_source
from runtime.model.session import ModelSession
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F32, F64, U8


class NetworkPredictor(Predictor):
    """Models of `input_frame` panel (one picture per eye and panel) or centre (one per eye), layout NCHW.

    Channels are panel-major, then eye, then RGB; black beside what an eye's picture of the contract's field of view
    covers, as the network was trained. Where the model answers with the outer panels alone, the centre
    is closed here, as the weighted mean of what each eye lacks.
    """

    def __init__(self, session: ModelSession, stack: PanelStack, *, source: Path) -> None:
        """Raises InputError where the model's fixed size is not the panels'."""
        contract = session.contract
        self.session, self.stack = session, stack
        self.name, self.provider, self.parameters = contract.name, session.provider, contract.parameters
        self.fell_back = session.fell_back
        for given, wanted, name in (
            (contract.width_px, stack.width_px, "width_px"),
            (contract.height_px, stack.height_px, "height_px"),
        ):
            if given and given != wanted:
                raise InputError(source, f"contract.{name}", f"made for {given}, the panels have {wanted}")
        if contract.layout != "NCHW":
            raise InputError(source, "contract.layout", f"{contract.layout} does not fit {contract.input_frame}")
        self._panels = range(stack.count) if contract.input_frame == "panel" else (stack.count // 2,)
        self._order = (0, 1) if contract.eye_order == "left-right" else (1, 0)
        channels = len(self._panels) * 2 * 3
        self._input = np.empty((1, channels, stack.height_px, stack.width_px), np.float32)
        self._layers = np.full((stack.count, stack.height_px, stack.width_px, 4), 255, np.uint8)
        table = np.arange(256, dtype=np.float32) / np.float32(255)
        self._table = table if contract.input_value == "intensity" else phase_from_intensity(table, contract.branch)

    @property
    def black_beside(self) -> bool:
        return self.session.contract.picture_fov_deg > 0

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return tuple(self.stack.panel(n) for n in self._panels)

    def solve(self, job: Job) -> Prediction:
        watch, images, eyes_m = Stopwatch(*STAGES), job.arrays, job.eyes_m
        channel = 0
        for raster in range(len(self._panels)):
            for side in self._order:
                picture = images[side][raster]
                cover = self._covered(eyes_m[side], self.stack.panel(self._panels[raster]))
                for c in range(3):
                    plane = np.ascontiguousarray(picture[..., c])
                    if cover is not None:
                        plane = np.asarray(cv2.min(plane, cover), np.uint8)
                    self._input[0, channel] = cv2.LUT(plane, self._table)
                    channel += 1
        watch.lap("prepare")
        answered = self.stack.count if self.session.contract.output == "panels" else self.stack.count - 1
        shape = (1, answered * 3, self.stack.height_px, self.stack.width_px)
        contract = self.session.contract
        answer = self.session.run({contract.inputs[0].name: self._input}, {contract.outputs[0].name: shape})[
            contract.outputs[0].name
        ]
        if not np.isfinite(answer.sum()):
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        values = np.clip(answer[0].reshape(answered, 3, *shape[2:]), 0, 1)
        outer = [n for n in range(self.stack.count) if answered == self.stack.count or n != self.stack.count // 2]
        for n, panel in zip(outer, values, strict=True):
            self._layers[n, ..., :3] = np.rint(panel.transpose(1, 2, 0) * 255)
        if answered < self.stack.count:
            self._close(images, eyes_m, outer)
        watch.lap("finish")
        return Prediction(self._layers, watch.stage_ms)

    def _covered(self, eye_m: F64, raster: PlaneRaster) -> U8 | None:
        """(h, w) how much of each pixel a picture of the contract's view covers, 0 to 255; None where it has none.

        What a white picture of the panels' pixels would leave there, black beside: bilinear, so that its edge fades
        over one pixel as it did in training. The least of it and the picture is what the network is fed: a still
        picture has faded by itself.
        """
        fov_deg = self.session.contract.picture_fov_deg
        if not fov_deg:
            return None
        width, height = self.stack.width_px, self.stack.height_px
        projection = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg)
        to_centres = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
        matrix = np.linalg.inv(to_centres) @ image_from_raster(projection, raster) @ to_centres
        white = np.full((height, width), 255, np.uint8)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(
            cv2.warpPerspective(white, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT), np.uint8
        )

    def _close(self, images: Sequence[Sequence[U8]], eyes_m: F64, outer: Sequence[int]) -> None:
        """The best centre panel for the outer ones: the mean of what the eyes lack (equal slopes assumed)."""
        centre = self.stack.count // 2
        raster = list(self._panels).index(centre)
        branch = self.session.contract.branch
        table = phase_from_intensity(np.arange(256, dtype=np.float32) / np.float32(255), branch)
        needs: list[F32] = []
        seen = buffer(self.stack.height_px, self.stack.width_px, np.float32)
        for side, eye_m in enumerate(eyes_m):
            need = cv2.LUT(np.ascontiguousarray(images[side][raster][..., :3]), table)
            for n in outer:
                matrix = target_from_source(eye_m, source=self.stack.panel(centre), target=self.stack.panel(n))
                panel = self._layers[n, ..., :3].astype(np.float32) / 255
                need = need - resample(panel, image_from_result=matrix, out=seen)
            needs.append(np.asarray(need, np.float32))
        self._layers[centre, ..., :3] = np.rint(np.clip((needs[0] + needs[1]) / 2, 0, 1) * 255)
