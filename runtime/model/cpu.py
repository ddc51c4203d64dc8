"""What surrounds the network, on the processor: 16-bit integers, by compiled kernels, a few rows at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np

from runtime.model.assembly import ArrayAssembly, fill_area
from runtime.model.compiled.panels import Panels
from runtime.model.contract import Contract
from runtime.model.job import Picture
from runtime.model.reprojection import CENTRE, NEUTRAL, OUTER, START, coarser
from runtime.model.resample import buffer, resample
from runtime.model.steps import Problem
from runtime.model.targets import FULL, Pictures, fill_targets, phase_codes
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F32, I16, U8
from runtime.support.gl import DrawnPicture


class CpuBackend:
    """Runs everywhere."""

    name = "cpu"
    context: object = None

    def state(self, contract: Contract, stack: PanelStack, *, threads: int) -> CpuState:
        return CpuState(contract, stack, threads=threads)

    def assembly(self, stack: PanelStack) -> ArrayAssembly:
        return ArrayAssembly(stack)

    def close(self) -> None:
        """It holds nothing."""


class CpuState:
    """A `SolverState`."""

    def __init__(self, contract: Contract, stack: PanelStack, *, threads: int) -> None:
        self._contract, self._size, self._threads = contract, stack, max(1, threads)
        self._by_kind: dict[tuple[int, int], Panels] = {}  # by channels and reduction
        self._pairs: dict[str, tuple[I16, I16]] = {}  # of both eyes or outer panels; sizes follow the viewer
        self._drawn: tuple[PixelRect, ...] = ()  # where the layers hold more than even panels
        self._layers: U8 = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)

    def begin(self, pictures: Sequence[Picture], problem: Problem) -> AbstractContextManager[None]:
        self._problem = problem
        self._full = self._panels = self._panels_of(1)
        if (reduction := problem.reduction) > 1:
            self._panels = self._panels_of(reduction)
        arrays = [picture.pixels() if isinstance(picture, DrawnPicture) else picture for picture in pictures]
        contract, box = self._contract, problem.boxes[CENTRE]
        self._pictures = Pictures(arrays, box, problem.channels, contract.emphasis, phase_codes(contract.branch))
        coarse = self._panels is not self._full
        self._reduced = self._panels.target if coarse else self._pair("reduced", *problem.reduced_size)
        fill_targets(self._pictures, [self._full.target, self._reduced])
        return nullcontext()

    def network_pictures(self) -> tuple[I16, I16]:
        problem, frame = self._problem, self._problem.frame
        left, right = self._reduced
        half = (right - left) >> 1
        residuals = self._pair("residuals", frame.width_px, frame.rows)
        for side, residual in enumerate((-half, half)):
            matrix = problem.reduced_from_frame(side)
            resample(residual, image_from_result=matrix, out=residuals[side], result_columns=frame.columns)
        return residuals

    def set_panel(self, panel: int, codes: I16, *, shown: bool) -> None:
        # By way of a raster as coarse as the answer: where columns are bent that is sampled linearly, whose kinks on
        # every pixel no correction could undo.
        problem, raster = self._problem, coarser(self._full.rasters[panel], self._contract.reduction)
        coarse = self._pair("answer", raster.width_px, raster.height_px)[OUTER.index(panel)]
        matrix, columns = problem.answer_from_raster(panel, raster), problem.answer_columns
        resample(codes, image_from_result=matrix, out=coarse, outside=START, cubic=True, image_columns=columns)
        self._panels.set_panel(panel, np.clip(coarse, 0, FULL, out=coarse), shown=shown)

    def project(self, panels: Sequence[int]) -> None:
        self._panels.project(panels)

    def correct(self, panel: int, *, size: float, shown: bool) -> None:
        self._panels.step(panel, size=size, shown=shown, fading=self._fading())

    def finish(self) -> U8:
        boxes = self._problem.boxes
        if self._drawn != boxes:
            for layer, box in zip(self._layers, boxes, strict=True):
                for area in box.beside(width_px=self._size.width_px, height_px=self._size.height_px):
                    fill_area(layer, area, (NEUTRAL, NEUTRAL, NEUTRAL))
            self._drawn = boxes
        self._whole().show(self._layers, boxes)
        return self._layers

    def close(self) -> None:
        self._by_kind = {}

    def _panels_of(self, reduction: int) -> Panels:
        """The problem's panels on rasters so many times coarser than their own."""
        problem, size = self._problem, self._size
        if (key := (problem.channels, reduction)) not in self._by_kind:
            width_px, height_px = (-(-px // reduction) for px in (size.width_px, size.height_px))
            size = replace(size, width_px=width_px, height_px=height_px)
            self._by_kind[key] = Panels(size, threads=self._threads, channels=problem.channels)
        panels = self._by_kind[key]
        panels.crop(problem.coarser_rasters(reduction), problem.stack, reduction)
        panels.set_eyes(problem.eyes_m, eye_sigma_mm=problem.eye_sigma_mm)
        return panels

    def _whole(self) -> Panels:
        """The panels on their own pixels."""
        if self._panels is not self._full:
            self._full.take(self._panels)
            self._panels = self._full
        return self._full

    def _pair(self, name: str, width_px: int, height_px: int) -> tuple[I16, I16]:
        channels = self._problem.channels
        shape = (height_px, width_px) if channels == 1 else (height_px, width_px, channels)
        if name not in self._pairs or self._pairs[name][0].shape != shape:
            self._pairs[name] = buffer(height_px, width_px, channels=channels), buffer(*shape[:2], channels=channels)
        return self._pairs[name]

    def _fading(self) -> tuple[F32, F32] | None:
        """How residuals end within a part of larger panels, along the centre panel's columns and rows; None: not at
        all."""
        fade = self._problem.fade
        if fade is None:
            return None
        matrix = self._problem.centre_from(self._panels.rasters[CENTRE].plane_from_raster())
        width_px, height_px = self._panels.size
        return fade.ray_weights(matrix, rows=height_px, columns=width_px)
