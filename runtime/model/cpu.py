"""What surrounds the network, on the processor: 16-bit integers, by compiled kernels, a few rows at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import cv2
import numpy as np

from runtime.model.assembly import ArrayAssembly
from runtime.model.channels import without_alpha
from runtime.model.compiled.joint import INTENSITY, JointState, rays_of
from runtime.model.compiled.level import Level
from runtime.model.compiled.wanted import fill_targets
from runtime.model.contract import Contract, Step
from runtime.model.job import Picture
from runtime.model.reprojection import CENTRE, EYES, NEUTRAL, OUTER
from runtime.model.resample import buffer, resample
from runtime.model.steps import Problem, reductions
from runtime.model.transfer import SUBCODE, phase_codes
from runtime.model.wanted import Pictures
from runtime.model.workspace import Workspace
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
        self._workspaces: dict[int, Workspace] = {}
        self._joint: dict[int, JointState] = {}
        self._stepped: JointState | None = None
        self._drawn: tuple[PixelRect, ...] = ()  # where the layers hold more than even panels
        self._layers: U8 = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)

    def begin(self, pictures: Sequence[Picture], problem: Problem) -> AbstractContextManager[None]:
        self._problem, self._stepped = problem, None
        if problem.channels not in self._workspaces:
            needed = reductions(self._contract)
            self._workspaces[problem.channels] = Workspace(
                self._size, needed, threads=self._threads, channels=problem.channels
            )
        self._workspace = self._workspaces[problem.channels]
        self._workspace.crop(problem.boxes, problem.stack)
        box = problem.boxes[CENTRE]
        arrays = [picture.pixels() if isinstance(picture, DrawnPicture) else picture for picture in pictures]

        contract, levels = self._contract, self._workspace.levels
        self._pictures = Pictures(arrays, box, problem.channels, contract.emphasis, phase_codes(contract.branch))
        fill_targets(self._pictures, [levels[reduction].target for reduction in sorted(levels)], threads=self._threads)
        for level in levels.values():
            level.slope_floor = self._contract.slope_floor
            level.set_eyes(problem.eyes_m, eye_sigma_mm=problem.eye_sigma_mm, least_px=contract.least_spread_px)
        return nullcontext()

    def network_pictures(self) -> tuple[I16, I16]:
        problem, size = self._problem, self._problem.reduced_size
        tail = (problem.channels,) if problem.channels > 1 else ()
        known = (level.target for level in self._workspace.levels.values() if level.size == size)
        pair = next(known, None)
        if pair is None:
            pair = tuple(np.empty(size[::-1] + tail, np.int16) for _ in EYES)
            fill_targets(self._pictures, [pair], threads=self._threads)
        left, right = pair
        half = (right - left) >> 1
        residuals = self._workspace.chain_buffers(problem.frame)
        for side, residual in enumerate((-half, half)):
            matrix = problem.reduced_from_frame(side)
            resample(residual, image_from_result=matrix, out=residuals[side], result_columns=problem.frame.columns)
        return residuals

    def set_panel(self, reduction: int, panel: int, codes: I16, *, shown: bool) -> None:
        level, problem = self._workspace.levels[reduction], self._problem
        matrix = problem.answer_from_raster(panel, level.rasters[panel])
        level.set_panel(panel, codes, matrix, columns=problem.answer_columns, shown=shown)

    def project(self, reduction: int, panels: Sequence[int]) -> None:
        self._workspace.levels[reduction].project(panels)

    def correct(self, reduction: int, panel: int, *, size: float, shown: bool) -> None:
        level = self._workspace.levels[reduction]
        level.step(panel, size=size, shown=shown, fading=self._fading(level))

    def start_joint(self) -> None:
        level, problem = self._workspace.levels[1], self._problem
        joint = self._joint.get(problem.channels)
        if joint is None:
            sizes = np.array([(self._size.height_px, self._size.width_px)] * 4)
            joint = JointState(sizes, channels=problem.channels, threads=self._threads)
            self._joint[problem.channels] = joint
        rasters = (*level.rasters, level.rasters[CENTRE])  # rays go through the centre panel's pixels
        joint.sizes = np.array([(raster.height_px, raster.width_px) for raster in rasters])
        level.spread = {}
        level.project(OUTER)
        level.show(self._layers, problem.boxes)
        for n, box in enumerate(problem.boxes):
            codes = without_alpha(np.ascontiguousarray(self._layers[n][box.slices]), problem.channels)
            _fill(joint.panels[n], codes, SUBCODE)
        asked = [buffer(*level.size[::-1], channels=problem.channels) for _ in EYES]
        intensities = (np.arange(256) * INTENSITY).astype(np.int16)
        width, height = level.size
        fill_targets(replace(self._pictures, table=intensities), [asked], threads=self._threads)
        for image, numbers in zip(asked, joint.targets, strict=True):
            numbers[:height, : width * problem.channels] = image.reshape(height, -1)
        joint.start()
        self._stepped = joint

    def joint(self, step: Step) -> None:
        problem, joint = self._problem, self._stepped
        assert joint is not None
        fade, fading = None, self._fading(self._workspace.levels[1])
        if fading is not None:
            columns = np.zeros(joint.panels.shape[2], np.float32)
            columns[: fading[0].size * problem.channels] = np.repeat(fading[0], problem.channels)
            fade = columns, fading[1]
        rays = rays_of(problem.rays(step.places), joint.sizes)
        joint.step(rays, size=step.size, momentum=step.momentum, floor=step.floor, fade=fade)

    def upsample(self, coarser_reduction: int, reduction: int, *, shown: bool) -> None:
        levels = self._workspace.levels
        levels[reduction].upsample(levels[coarser_reduction], shown=shown)

    def finish(self) -> U8:
        boxes = self._problem.boxes
        if self._drawn != boxes:
            self._layers[..., :3] = NEUTRAL
            self._drawn = boxes
        if self._stepped is None:
            self._workspace.levels[1].show(self._layers, boxes)
        else:
            self._workspace.levels[1].show_panels(dict(enumerate(self._stepped.last)), self._layers, boxes)
        return self._layers

    def close(self) -> None:
        self._workspaces, self._joint = {}, {}

    def _fading(self, level: Level) -> tuple[F32, F32] | None:
        """How residuals end within a part of larger panels, along a level's columns and rows; None: not at all."""
        fade = self._problem.fade
        if fade is None:
            return None
        matrix = self._problem.centre_from(level.rasters[CENTRE].plane_from_raster())
        width_px, height_px = level.size
        return fade.ray_weights(matrix, rows=height_px, columns=width_px)


def _fill(numbers: I16, codes: U8, unit: float) -> None:
    """(rows, numbers) of a buffer by codes (h, w[, 3])."""
    table = (np.arange(256) * unit).astype(np.int16)
    height, width = codes.shape[0], codes[0].size
    numbers[:height, :width] = cv2.LUT(codes, table).reshape(height, width)
