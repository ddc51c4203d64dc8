"""The unrolled solver: a network along the eyes' line, local corrections, and the centre panel in closed form.

The first steps may work on coarser rasters, where they cost a fraction; the last ones see every pixel. Outer panels
end rounded to what 8 bits can show, so that the centre panel answers to what the eyes will really see. One
correction changes one panel, rear and front in turn: twice as much for the time as both at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.errors import ModelFailure
from runtime.model.base import Prediction, Predictor
from runtime.model.chain import ChainFrame, chain_frame, chain_modes
from runtime.model.channels import RGBA_FROM, is_grey, without_alpha
from runtime.model.contract import Step
from runtime.model.fade import Fade
from runtime.model.pyramid_level import CENTRE, FRONT, I16, NEUTRAL, OUTER, REAR, START, PyramidLevel
from runtime.model.resample import resample
from runtime.model.rows import RowPool
from runtime.model.session import ModelSession
from runtime.model.timing import Stopwatch
from runtime.model.transfer import SUBCODE, phase_codes, pre_emphasised
from runtime.model.visible import visible_boxes
from runtime.model.workspace import Workspace
from runtime.optics.pupil import POINT_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, U8

HALF_IPD_M = 0.031


class UnrolledPredictor(Predictor):
    """Models of `input_frame` chain: three panels, evenly spaced or nearly so, any pose.

    Where `one_channel` is set, grey pictures are solved in one channel of three: in less than half the time.
    """

    def __init__(
        self,
        session: ModelSession,
        stack: PanelStack,
        *,
        threads: int = 2,
        one_channel: bool = False,
    ) -> None:
        """one_channel: whether pictures without colour are solved in a single channel."""
        self.session, self.stack = session, stack
        self.name, self.provider = session.contract.name, session.provider
        self.parameters = session.contract.parameters
        self.one_channel = one_channel
        self._threads = threads
        self._twin: UnrolledPredictor | None = None  # for eyes above each other
        self.fade: Fade | None = None  # how this stack ends, where it is a part of larger panels
        self._rows = RowPool(threads, width_px=stack.width_px)
        self._workspaces: dict[int, Workspace] = {}
        self._boxes: tuple[PixelRect, ...] = ()
        self._drawn: tuple[PixelRect, ...] = ()  # where the layers hold more than even panels
        self._layers = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return (self.stack.panel(CENTRE),)

    @property
    def interpolation(self) -> str:
        return self.session.contract.interpolation

    @property
    def pre_emphasis(self) -> float:
        return self.session.contract.emphasis

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        return (visible_boxes(eyes_m, self.stack)[CENTRE].slices,)

    def predict(self, images: Sequence[Sequence[U8]], eyes_m: F64, *, eye_sigma_mm: float = POINT_MM) -> Prediction:
        across_m = np.abs(eyes_m[1] - eyes_m[0])
        if across_m[2] > across_m[1]:
            return self._turned(images, eyes_m, eye_sigma_mm=eye_sigma_mm)
        watch = Stopwatch()
        contract = self.session.contract
        # One eye that stands for both asks for no difference: the chain may run along any line.
        along_m = eyes_m if across_m.any() else eyes_m + HALF_IPD_M * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        try:
            frame = chain_frame(along_m, self.stack, cell_px=contract.cell_px, reduction=contract.reduction)
        except ValueError as error:
            raise ModelFailure(str(error)) from None
        self._boxes = visible_boxes(eyes_m, self.stack)
        cut = [image[0][self._boxes[CENTRE].slices] for image in images]
        self.channels = 1 if self.one_channel and all(is_grey(picture) for picture in cut) else 3
        workspace = self._workspace()
        pictures = [pre_emphasised(without_alpha(picture, self.channels), contract.emphasis) for picture in cut]
        for level in workspace.levels.values():
            level.wanted = [np.asarray(phases, np.int16) for phases in self._phases(pictures, level.size)]
        last = {n: _last_change(contract.steps, n) for n in OUTER}
        for level in workspace.levels.values():
            level.set_eye_sigma(eyes_m, eye_sigma_mm=eye_sigma_mm)
        level = workspace.levels[contract.steps[0].reduction]
        for index, step in enumerate(contract.steps):
            if step.reduction != level.reduction:
                coarser, level = level, workspace.levels[step.reduction]
                level.upsample(coarser, shown=False)
                level.project(OUTER, eyes_m)
            if index:
                level.update_residuals()
                if self.fade is not None:
                    self.fade.soften(level, self._centre_from(level.rasters[CENTRE].plane_from_raster()))
            shown = {n: index == last[n] for n in OUTER}
            if step.kind == "chain":
                residuals = self._initial_residuals(pictures, workspace)
                panels = self._network(residuals, frame, eyes_m, watch, workspace=workspace, eye_sigma_mm=eye_sigma_mm)
                _set_outer_panels(level, panels, frame, shown=shown)
                changed: tuple[int, ...] = OUTER
            else:
                changed = (FRONT if step.kind == "front" else REAR,)
                level.correct(changed[0], eyes_m, size=step.size, shown=shown[changed[0]])
            level.project(changed, eyes_m)
        self._finish(level, eyes_m, workspace)
        watch.lap("finish")
        return Prediction(self._layers, watch.stage_ms)

    def close(self) -> None:
        self._rows.close()
        if self._twin is not None:
            self._twin.close()

    def _turned(self, images: Sequence[Sequence[U8]], eyes_m: F64, *, eye_sigma_mm: float) -> Prediction:
        """Eyes above each other: the same problem with rows for columns, solved by a twin for panels turned so."""
        if self._twin is None:
            self._twin = UnrolledPredictor(self.session, self.stack.turned(), threads=self._threads)
        twin = self._twin
        twin.one_channel, twin.fade = self.one_channel, self.fade and self.fade.turned()
        # A picture's rows become its columns: what was down (-z) is to the right (+y), what was right is down.
        turned_m = np.stack([eyes_m[:, 0], -eyes_m[:, 2], -eyes_m[:, 1]], axis=1)
        order = (0, 1) if turned_m[1, 1] > turned_m[0, 1] else (1, 0)
        pictures = [[np.asarray(cv2.transpose(images[side][0]), np.uint8)] for side in order]
        solved = twin.predict(pictures, turned_m[list(order)], eye_sigma_mm=eye_sigma_mm)
        for layer, part in zip(self._layers, solved.layers, strict=True):
            cv2.transpose(part, dst=layer)
        self._drawn, self.channels = (), twin.channels
        return Prediction(self._layers, solved.stage_ms)

    def _workspace(self) -> Workspace:
        """What the steps work on, cut to what the eyes look through; panels are even beside it."""
        if self.channels not in self._workspaces:
            reductions = {1} | {step.reduction for step in self.session.contract.steps}
            self._workspaces[self.channels] = Workspace(self.stack, reductions, rows=self._rows, channels=self.channels)
        workspace = self._workspaces[self.channels]
        workspace.crop(self._boxes, self.stack)
        return workspace

    def _phases(self, pictures: Sequence[U8], size: tuple[int, int]) -> list[Any]:
        """Phase sums of two pictures at a size, averaged as codes."""
        table = phase_codes(self.session.contract.branch)
        same = pictures[0].shape[1::-1] == size
        sized = pictures if same else [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in pictures]
        return [cv2.LUT(picture, table) for picture in sized]

    def _finish(self, level: PyramidLevel, eyes_m: F64, workspace: Workspace) -> None:
        """Close the centre panel on every pixel, and bring the panels into their layers."""
        whole = workspace.levels[1]
        if level is not whole:
            whole.upsample(level, shown=True)
            whole.project(OUTER, eyes_m)
        whole.close_centre(workspace.shown[CENTRE])
        if self._drawn != self._boxes:
            self._layers[..., :3] = NEUTRAL
            self._drawn = self._boxes
        for n, box in enumerate(self._boxes):
            if n != CENTRE:
                cv2.convertScaleAbs(whole.outer[n], dst=workspace.shown[n], alpha=1 / SUBCODE)
            self._layers[n][box.slices] = cv2.cvtColor(workspace.shown[n], RGBA_FROM[self.channels])

    def _initial_residuals(self, pictures: Sequence[U8], workspace: Workspace) -> list[I16]:
        """What each eye lacks while the outer panels are even, at the network's coarser raster."""
        size = self._reduced_size()
        known = (level.wanted for level in workspace.levels.values() if level.size == size)
        left, right = next(known, None) or self._phases(pictures, size)
        half = (np.asarray(right, np.int16) - np.asarray(left, np.int16)) >> 1
        return [-half, half]

    def _reduced_size(self) -> tuple[int, int]:
        reduction, box = self.session.contract.reduction, self._boxes[CENTRE]
        return max(1, box.width_px // reduction), max(1, box.height_px // reduction)

    def _network(
        self,
        residuals: Sequence[I16],
        frame: ChainFrame,
        eyes_m: F64,
        watch: Stopwatch,
        *,
        workspace: Workspace,
        eye_sigma_mm: float,
    ) -> dict[int, I16]:
        """The network's answer: both outer panels on the chain frame's raster, from one parallax before its first
        column, in fixed-point codes."""
        width, height = self._reduced_size()
        centre = self._boxes[CENTRE].cut(self.stack.panel(CENTRE))
        reduced_from_full = np.diag([width / centre.width_px, height / centre.height_px, 1.0])
        reduced_from_plane = reduced_from_full @ centre.raster_from_plane()
        seen = workspace.chain_buffers(frame)
        for side, eye_m in enumerate(eyes_m):
            matrix = reduced_from_plane @ frame.plane_from_frame(eye_m, x_m=self.stack.x_m[CENTRE])
            resample(residuals[side], image_from_result=matrix, out=seen[side])
        waves, shifted_waves, spectrum, modes_in = chain_modes(frame.cells)
        left, right = (image.reshape(frame.rows, frame.cells, -1) for image in seen)
        feeds: dict[str, NDArray[Any]] = {
            "left": left,
            "right": right,
            "waves": waves,
            "shifted_waves": shifted_waves,
            "spectrum": spectrum,
            "modes_in": modes_in,
            "doubt": frame.doubt(self.stack, eye_sigma_mm=eye_sigma_mm),
        }
        shape = (frame.rows, frame.cells + 1, left.shape[2])
        watch.lap("prepare")
        answer = self.session.run(feeds, {"rear": shape, "front": shape, "check": (1,)})
        if not np.isfinite(answer["check"]).all():
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        tail = seen[0].shape[2:]
        panels = {n: answer[name].reshape(frame.rows, -1, *tail) for n, name in ((REAR, "rear"), (FRONT, "front"))}
        return panels if self.fade is None else {n: self._faded(panel, frame) for n, panel in panels.items()}

    def _faded(self, panel: I16, frame: ChainFrame) -> I16:
        """A panel that ends, even, within this part of the panels."""
        assert self.fade is not None
        plane_from_wave = frame.plane_from_frame(frame.middle_m, x_m=self.stack.x_m[CENTRE])
        plane_from_wave = plane_from_wave @ np.array([[1.0, 0.0, -frame.cell_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        rows, columns = panel.shape[:2]
        weights = self.fade.wave_weights(self._centre_from(plane_from_wave), rows=rows, columns=columns)
        return np.asarray((panel - START) * (weights if panel.ndim == 3 else weights[..., 0]) + START, np.int16)

    def _centre_from(self, plane_from_raster: F64) -> F64:
        """3x3: the centre panel's pixels from a raster's on its plane."""
        return self.stack.panel(CENTRE).raster_from_plane() @ plane_from_raster


def _set_outer_panels(
    level: PyramidLevel, panels: Mapping[int, I16], frame: ChainFrame, *, shown: dict[int, bool]
) -> None:
    """Both outer panels as the network wants them."""
    for n, codes in panels.items():
        panel = level.rasters[n]
        plane_from_layer = np.linalg.inv(level.layer_from_seen(n, frame.middle_m))
        matrix = frame.frame_from_plane(x_m=panel.x_m) @ plane_from_layer @ panel.plane_from_raster()
        matrix /= matrix[2, 2]
        matrix[0, 2] += frame.cell_px  # the answer begins one parallax before the first column
        level.set_panel(n, codes, matrix, shown=shown[n])


def _last_change(steps: Sequence[Step], panel: int) -> int:
    """The last step that changes an outer panel on every pixel; none if all are coarser."""
    kinds = {"chain", "front" if panel == FRONT else "rear"}
    return max((index for index, step in enumerate(steps) if step.kind in kinds and step.reduction == 1), default=-1)
