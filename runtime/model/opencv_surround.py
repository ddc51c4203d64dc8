"""What surrounds the network, by OpenCV and numpy on the processor: 16-bit integers, a few rows at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import cv2
import numpy as np

from runtime.model.assembly import ArrayAssembly
from runtime.model.channels import without_alpha
from runtime.model.contract import Contract
from runtime.model.loops import inner_loops
from runtime.model.pyramid_level import CENTRE, EYES, I16, NEUTRAL, PyramidLevel
from runtime.model.resample import resample
from runtime.model.rows import RowPool
from runtime.model.schedule import Picture, Problem, reductions
from runtime.model.transfer import phase_codes, pre_emphasised
from runtime.model.workspace import Workspace
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.support.gl import DrawnPicture


class OpenCvBackend:
    """Runs everywhere."""

    name = "opencv"
    context: object = None

    def __init__(self, *, compiled: bool = True) -> None:
        """compiled: whether corrections are done by compiled loops, where there are any."""
        self.compiled = compiled

    def surround(self, contract: Contract, stack: PanelStack, *, threads: int) -> OpenCvSurround:
        return OpenCvSurround(
            contract, stack, threads=threads, level=inner_loops().level if self.compiled else PyramidLevel
        )

    def assembly(self, stack: PanelStack) -> ArrayAssembly:
        return ArrayAssembly(stack)

    def close(self) -> None:
        """It holds nothing."""


class OpenCvSurround:
    """A `Surround`."""

    def __init__(self, contract: Contract, stack: PanelStack, *, threads: int, level: type[PyramidLevel]) -> None:
        self._contract, self._stack, self._level = contract, stack, level
        self._rows = RowPool(threads, width_px=stack.width_px)
        self._workspaces: dict[int, Workspace] = {}
        self._drawn: tuple[PixelRect, ...] = ()  # where the layers hold more than even panels
        self._layers: U8 = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)
        self._pictures: list[U8] = []

    def begin(self, pictures: Sequence[Picture], problem: Problem) -> AbstractContextManager[None]:
        self._problem = problem
        if problem.channels not in self._workspaces:
            self._workspaces[problem.channels] = Workspace(
                self._stack, reductions(self._contract), level=self._level, rows=self._rows, channels=problem.channels
            )
        self._workspace = self._workspaces[problem.channels]
        self._workspace.crop(problem.boxes, self._stack)
        box = problem.boxes[CENTRE]
        arrays = [picture.pixels() if isinstance(picture, DrawnPicture) else picture for picture in pictures]

        def prepared(picture: U8) -> U8:
            return pre_emphasised(without_alpha(picture[box.slices], problem.channels), self._contract.emphasis)

        self._pictures = self._rows.map(prepared, arrays)
        for level in self._workspace.levels.values():
            self._fill_phases(level.wanted)
            level.slope_floor = self._contract.slope_floor
            level.set_eye_sigma(
                problem.eyes_m, eye_sigma_mm=problem.eye_sigma_mm, least_px=self._contract.least_spread_px
            )
        return nullcontext()

    def network_pictures(self) -> tuple[I16, I16]:
        problem, size = self._problem, self._problem.reduced_size
        tail = (problem.channels,) if problem.channels > 1 else ()
        known = (level.wanted for level in self._workspace.levels.values() if level.size == size)
        left, right = next(known, None) or self._fill_phases([np.empty(size[::-1] + tail, np.int16) for _ in EYES])
        half = (right - left) >> 1
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
        fading = None
        if problem.fade is not None:
            width_px, height_px = level.size
            matrix = problem.centre_from(level.rasters[CENTRE].plane_from_raster())
            fading = problem.fade.softening(matrix, rows=height_px, columns=width_px)
        level.step(panel, problem.eyes_m, size=size, shown=shown, fading=fading)

    def upsample(self, coarser_reduction: int, reduction: int, *, shown: bool) -> None:
        levels = self._workspace.levels
        levels[reduction].upsample(levels[coarser_reduction], shown=shown)

    def finish(self) -> U8:
        boxes = self._problem.boxes
        if self._drawn != boxes:
            self._layers[..., :3] = NEUTRAL
            self._drawn = boxes
        self._workspace.levels[1].show(self._layers, boxes)
        return self._layers

    def close(self) -> None:
        self._rows.close()

    def _fill_phases(self, wanted: Sequence[I16]) -> Sequence[I16]:
        """Phase sums of the pictures at the size of these images, averaged as codes: into them."""
        table = phase_codes(self._contract.branch)

        def fill(item: tuple[U8, I16]) -> None:
            picture, image = item
            size = image.shape[1::-1]
            same = picture.shape[1::-1] == size
            cv2.LUT(picture if same else cv2.resize(picture, size, interpolation=cv2.INTER_AREA), table, dst=image)

        self._rows.map(fill, list(zip(self._pictures, wanted, strict=True)))
        return wanted
