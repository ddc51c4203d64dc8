"""Proposals for the solver, made by networks that map each eye's whole picture to panel values."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.errors import InputError, ModelFailure
from runtime.kernels import FULL
from runtime.model.geometry import Geometry, panel_from_middle
from runtime.model.job import Job
from runtime.model.session import ModelSession
from runtime.model.warp import picture_on, resample
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import I16, U8


class PictureProposal:
    """Proposals made by a model whose `input_frame` is `panel` or `centre`.

    The network reads one picture per eye for every panel (`panel`) or only for the centre panel (`centre`). The layout
    is NCHW, with channels ordered by panel, then by eye, then by colour. Each picture is warped to the panel's pixels
    (EyeReal supplement, (47)) and is black outside the contract's field of view, as in training.
    """

    any_raster = False  # the network can propose only whole panels of one size

    def __init__(self, session: ModelSession, stack: PanelStack, *, source: Path) -> None:
        """Create the proposal. Raises InputError if the contract or the graph's ports do not fit."""
        contract = session.contract
        self.session, self._stack = session, stack
        for given, wanted, name in (
            (contract.width_px, stack.width_px, "width_px"),
            (contract.height_px, stack.height_px, "height_px"),
        ):
            if given and given != wanted:
                raise InputError(
                    source,
                    f"contract.{name}",
                    f"is {given}, but the panels have {wanted}; export the model for this size",
                )
        if contract.layout != "NCHW":
            raise InputError(
                source,
                "contract.layout",
                f"{contract.layout} cannot be used with the input frame {contract.input_frame}",
            )
        self._panels = range(stack.count) if contract.input_frame == "panel" else (stack.count // 2,)
        self._order = (0, 1) if contract.eye_order == "left-right" else (1, 0)
        channels = len(self._panels) * 2 * 3
        self._input = np.empty((1, channels, stack.height_px, stack.width_px), np.float32)
        self._answered = [n for n in range(stack.count) if contract.output == "panels" or n != stack.count // 2]
        self._answer = (1, len(self._answered) * 3, stack.height_px, stack.width_px)
        feed, answer = contract.inputs[0].name, contract.outputs[0].name
        session.check_fits(source, {feed: self._input.shape}, {answer: self._answer})
        table = np.arange(256, dtype=np.float32) / np.float32(255)
        self._table = table if contract.input_value == "intensity" else phase_from_intensity(table, contract.branch)

    def panels(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        contract, channel = self.session.contract, 0
        for n in self._panels:
            for side in self._order:
                for plane in cv2.split(self._seen(job, n, side))[:3]:
                    self._input[0, channel] = cv2.LUT(plane, self._table)
                    channel += 1
        watch.lap("prepare")
        name, answered, shape = contract.outputs[0].name, self._answered, self._answer
        answer = self.session.run({contract.inputs[0].name: self._input}, {name: shape})[name]
        if not np.isfinite(answer.sum()):
            raise ModelFailure("the network's output contains values that are not finite")
        watch.lap("inference")
        values = np.rint(np.clip(answer[0].reshape(len(answered), 3, *shape[2:]), 0, 1) * FULL).astype(np.int16)
        return {
            n: np.ascontiguousarray(panel[:, *geometry.boxes[n].slices].transpose(1, 2, 0))
            for n, panel in zip(answered, values, strict=True)
        }

    def _seen(self, job: Job, n: int, side: int) -> U8:
        """Warp an eye's picture to panel `n`'s pixels, black outside a field of view that the contract limits."""
        stack, eye_m, view, middle = self._stack, job.eyes_m[side], job.views[side], self._stack.count // 2
        rasters, size = [stack.panel(n) for n in range(stack.count)], (stack.height_px, stack.width_px)
        panel_from_mid = panel_from_middle(stack, rasters, eye_m, n) if n != middle else np.eye(3)
        fov_deg = self.session.contract.picture_fov_deg
        edge = cv2.BORDER_CONSTANT if fov_deg else cv2.BORDER_REPLICATE
        mid_from_panel = np.asarray(np.linalg.inv(panel_from_mid), np.float64)
        picture = picture_on(view, rasters[middle], middle_from_result=mid_from_panel, edge=edge, size=size)
        if not fov_deg:
            return picture
        # Warp a white picture with this field of view bilinearly, so that its edge fades over one pixel as in training.
        projection = image_from_stack(eye_m, width_px=size[1], height_px=size[0], fov_deg=fov_deg)
        cover = resample(np.full(size, 255, np.uint8), image_from_raster(projection, rasters[n]), size=size)
        return np.asarray(cv2.min(picture, cv2.merge([cover] * picture.shape[2])), np.uint8)
