"""What surrounds the network, by OpenCV and numpy on the processor: 16-bit integers, a few rows at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np

from runtime.model.assembly import ArrayAssembly
from runtime.model.contract import Contract
from runtime.model.fade import FadeCodes
from runtime.model.loops import Loops, inner_loops
from runtime.model.pyramid_level import CENTRE, EYES, NEUTRAL, PyramidLevel
from runtime.model.resample import resample
from runtime.model.rows import RowPool
from runtime.model.schedule import Picture, Problem, reductions
from runtime.model.wanted import Pictures, fill_wanted
from runtime.model.workspace import Workspace
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import I16, U8
from runtime.support.gl import DrawnPicture


class OpenCvBackend:
    """Runs everywhere."""

    name = "opencv"
    context: object = None

    def __init__(self, *, compiled: bool = True) -> None:
        """compiled: whether corrections are done by compiled loops, where there are any."""
        self.compiled = compiled

    @property
    def fade_codes(self) -> FadeCodes:
        return self._loops().fade_codes

    def _loops(self) -> Loops:
        return inner_loops() if self.compiled else Loops(PyramidLevel, "OpenCV's, as asked for")

    def surround(self, contract: Contract, stack: PanelStack, *, threads: int) -> OpenCvSurround:
        return OpenCvSurround(contract, stack, threads=threads, loops=self._loops())

    def assembly(self, stack: PanelStack) -> ArrayAssembly:
        return ArrayAssembly(stack)

    def close(self) -> None:
        """It holds nothing."""


class OpenCvSurround:
    """A `Surround`."""

    def __init__(self, contract: Contract, stack: PanelStack, *, threads: int, loops: Loops) -> None:
        self._contract, self._stack, self._loops = contract, stack, loops
        self._rows = RowPool(threads, width_px=stack.width_px)
        self._workspaces: dict[int, Workspace] = {}
        self._drawn: tuple[PixelRect, ...] = ()  # where the layers hold more than even panels
        self._layers: U8 = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)

    def begin(
        self, pictures: Sequence[Picture], problem: Problem, *, again: bool = False
    ) -> AbstractContextManager[None]:
        self._problem = problem
        if problem.channels not in self._workspaces:
            needed, kind = reductions(self._contract), self._loops.level
            self._workspaces[problem.channels] = Workspace(
                self._stack, needed, level=kind, rows=self._rows, channels=problem.channels
            )
        self._workspace = self._workspaces[problem.channels]
        self._workspace.crop(problem.boxes, self._stack)
        box = problem.boxes[CENTRE]
        arrays = [picture.pixels() if isinstance(picture, DrawnPicture) else picture for picture in pictures]

        contract, levels = self._contract, self._workspace.levels
        self._pictures = Pictures(arrays, box, problem.channels, contract.emphasis, contract.branch)
        used = [levels[reduction] for reduction in ([1] if again else sorted(levels))]
        self._loops.fill_wanted(self._pictures, [level.wanted for level in used], rows=self._rows)
        for level in used:
            level.slope_floor = self._contract.slope_floor
            level.set_eye_sigma(
                problem.eyes_m, eye_sigma_mm=problem.eye_sigma_mm, least_px=self._contract.least_spread_px
            )
        return nullcontext()

    def network_pictures(self) -> tuple[I16, I16]:
        problem, size = self._problem, self._problem.reduced_size
        tail = (problem.channels,) if problem.channels > 1 else ()
        known = (level.wanted for level in self._workspace.levels.values() if level.size == size)
        pair = next(known, None)
        if pair is None:
            pair = tuple(np.empty(size[::-1] + tail, np.int16) for _ in EYES)
            fill_wanted(self._pictures, [pair], rows=self._rows)
        left, right = pair
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
