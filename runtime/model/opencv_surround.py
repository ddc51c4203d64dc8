"""What surrounds the network, by OpenCV and numpy on the processor: 16-bit integers, a few rows at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import cv2
import numpy as np

from runtime.model.assembly import ArrayAssembly
from runtime.model.channels import RGBA_FROM, without_alpha
from runtime.model.contract import Contract
from runtime.model.pyramid_level import CENTRE, I16, NEUTRAL, OUTER, PyramidLevel
from runtime.model.resample import resample
from runtime.model.rows import RowPool
from runtime.model.schedule import Picture, Problem, reductions
from runtime.model.transfer import SUBCODE, phase_codes, pre_emphasised
from runtime.model.workspace import Workspace
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.support.gl import DrawnPicture


class OpenCvBackend:
    """Runs everywhere."""

    name = "opencv"
    context: object = None

    def surround(self, contract: Contract, stack: PanelStack, *, threads: int) -> OpenCvSurround:
        return OpenCvSurround(contract, stack, threads=threads)

    def assembly(self, stack: PanelStack) -> ArrayAssembly:
        return ArrayAssembly(stack)

    def close(self) -> None:
        """It holds nothing."""


class OpenCvSurround:
    """A `Surround`."""

    def __init__(self, contract: Contract, stack: PanelStack, *, threads: int) -> None:
        self._contract, self._stack = contract, stack
        self._rows = RowPool(threads, width_px=stack.width_px)
        self._workspaces: dict[int, Workspace] = {}
        self._drawn: tuple[PixelRect, ...] = ()  # where the layers hold more than even panels
        self._layers: U8 = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)
        self._pictures: list[U8] = []

    def begin(self, pictures: Sequence[Picture], problem: Problem) -> AbstractContextManager[None]:
        self._problem = problem
        if problem.channels not in self._workspaces:
            self._workspaces[problem.channels] = Workspace(
                self._stack, reductions(self._contract), rows=self._rows, channels=problem.channels
            )
        self._workspace = self._workspaces[problem.channels]
        self._workspace.crop(problem.boxes, self._stack)
        box = problem.boxes[CENTRE]
        arrays = [picture.pixels() if isinstance(picture, DrawnPicture) else picture for picture in pictures]

        def prepared(picture: U8) -> U8:
            return pre_emphasised(without_alpha(picture[box.slices], problem.channels), self._contract.emphasis)

        self._pictures = self._rows.map(prepared, arrays)
        for level in self._workspace.levels.values():
            level.wanted = [np.asarray(phases, np.int16) for phases in self._phases(level.size)]
            level.set_eye_sigma(
                problem.eyes_m, eye_sigma_mm=problem.eye_sigma_mm, least_px=self._contract.least_spread_px
            )
        return nullcontext()

    def network_pictures(self) -> tuple[I16, I16]:
        problem, size = self._problem, self._problem.reduced_size
        known = (level.wanted for level in self._workspace.levels.values() if level.size == size)
        left, right = next(known, None) or self._phases(size)
        half = (np.asarray(right, np.int16) - np.asarray(left, np.int16)) >> 1
        seen = self._workspace.chain_buffers(problem.frame)
        for side, lacks in enumerate((-half, half)):
            matrix = problem.reduced_from_frame(side)
            resample(lacks, image_from_result=matrix, out=seen[side], result_columns=problem.frame.columns)
        return seen

    def set_panel(self, reduction: int, panel: int, codes: I16, *, shown: bool) -> None:
        level, problem = self._workspace.levels[reduction], self._problem
        matrix = problem.answer_from_raster(panel, level.rasters[panel])
        level.set_panel(panel, codes, matrix, columns=problem.answer_columns, shown=shown)

    def project(self, reduction: int, panels: Sequence[int]) -> None:
        self._workspace.levels[reduction].project(panels, self._problem.eyes_m)

    def correct(self, reduction: int, panel: int, *, size: float, shown: bool) -> None:
        level, problem = self._workspace.levels[reduction], self._problem
        level.update_residuals()
        if problem.fade is not None:
            problem.fade.soften(level.residual, problem.centre_from(level.rasters[CENTRE].plane_from_raster()))
        level.correct(panel, problem.eyes_m, size=size, shown=shown)

    def upsample(self, coarser_reduction: int, reduction: int, *, shown: bool) -> None:
        levels = self._workspace.levels
        levels[reduction].upsample(levels[coarser_reduction], shown=shown)

    def finish(self) -> U8:
        workspace, boxes = self._workspace, self._problem.boxes
        whole: PyramidLevel = workspace.levels[1]
        whole.close_centre(workspace.shown[CENTRE])
        if self._drawn != boxes:
            self._layers[..., :3] = NEUTRAL
            self._drawn = boxes
        for n, box in enumerate(boxes):
            if n in OUTER:
                cv2.convertScaleAbs(whole.outer[n], dst=workspace.shown[n], alpha=1 / SUBCODE)
            self._layers[n][box.slices] = cv2.cvtColor(workspace.shown[n], RGBA_FROM[self._problem.channels])
        return self._layers

    def close(self) -> None:
        self._rows.close()

    def _phases(self, size: tuple[int, int]) -> list[Any]:
        """Phase sums of the pictures at a size, averaged as codes."""
        pictures, table = self._pictures, phase_codes(self._contract.branch)
        same = pictures[0].shape[1::-1] == size

        def phases(picture: U8) -> Any:
            return cv2.LUT(picture if same else cv2.resize(picture, size, interpolation=cv2.INTER_AREA), table)

        return self._rows.map(phases, pictures)
