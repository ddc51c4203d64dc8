"""Whole-picture networks as proposals: eye pictures on panel rasters to panel values."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.errors import InputError, ModelFailure
from runtime.model.geometry import Geometry
from runtime.model.job import Job
from runtime.model.session import ModelSession
from runtime.model.targets import FULL
from runtime.model.warp import resample
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F64, I16, U8


class PictureProposal:
    """Models of `input_frame` panel (one picture per eye and panel) or centre (one per eye), layout NCHW.

    Channels are panel-major, then eye, then RGB; black beside what an eye's picture of the contract's field of view
    covers, as the network was trained.
    """

    def __init__(self, session: ModelSession, stack: PanelStack, *, source: Path) -> None:
        """Raises InputError where the model's fixed size is not the panels'."""
        contract = session.contract
        self.session, self._stack = session, stack
        for given, wanted, name in (
            (contract.width_px, stack.width_px, "width_px"),
            (contract.height_px, stack.height_px, "height_px"),
        ):
            if given and given != wanted:
                raise InputError(source, f"contract.{name}", f"made for {given}, the panels have {wanted}")
        if contract.layout != "NCHW":
            raise InputError(source, "contract.layout", f"{contract.layout} does not fit {contract.input_frame}")
        self._panels = range(stack.count) if contract.input_frame == "panel" else (stack.count // 2,)
        self.rasters: tuple[PlaneRaster, ...] = tuple(stack.panel(n) for n in self._panels)
        self._order = (0, 1) if contract.eye_order == "left-right" else (1, 0)
        channels = len(self._panels) * 2 * 3
        self._input = np.empty((1, channels, stack.height_px, stack.width_px), np.float32)
        table = np.arange(256, dtype=np.float32) / np.float32(255)
        self._table = table if contract.input_value == "intensity" else phase_from_intensity(table, contract.branch)

    @property
    def black_beside(self) -> bool:
        """Whether still pictures end in black, not in their repeated edge."""
        return self.session.contract.picture_fov_deg > 0

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        contract, count, images, channel = self.session.contract, self._stack.count, job.arrays, 0
        for number, raster in enumerate(self.rasters):
            for side in self._order:
                cover = self._covered(job.eyes_m[side], raster)
                for plane in cv2.split(images[side][number])[:3]:
                    covered = np.asarray(plane if cover is None else cv2.min(plane, cover), np.uint8)
                    self._input[0, channel] = cv2.LUT(covered, self._table)
                    channel += 1
        watch.lap("prepare")
        answered = [n for n in range(count) if contract.output == "panels" or n != count // 2]
        shape = (1, len(answered) * 3, self._stack.height_px, self._stack.width_px)
        name = contract.outputs[0].name
        answer = self.session.run({contract.inputs[0].name: self._input}, {name: shape})[name]
        if not np.isfinite(answer.sum()):
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        values = np.rint(np.clip(answer[0].reshape(len(answered), 3, *shape[2:]), 0, 1) * FULL).astype(np.int16)
        return {
            n: np.ascontiguousarray(panel[:, *geometry.boxes[n].slices].transpose(1, 2, 0))
            for n, panel in zip(answered, values, strict=True)
        }

    def _covered(self, eye_m: F64, raster: PlaneRaster) -> U8 | None:
        """(h, w) how much of each pixel a picture of the contract's view covers, 0 to 255; None where it has none.

        What a white picture of the panels' pixels would leave there, black beside: bilinear, so that its edge fades
        over one pixel as it did in training. The least of it and the picture is what the network is fed: a still
        picture has faded by itself.
        """
        fov_deg = self.session.contract.picture_fov_deg
        if not fov_deg:
            return None
        width, height = self._stack.width_px, self._stack.height_px
        projection = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg)
        white = np.full((height, width), 255, np.uint8)
        return np.asarray(resample(white, image_from_raster(projection, raster), size=(height, width)), np.uint8)
