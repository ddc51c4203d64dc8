"""Solver backend for the processor. It updates panels of 16-bit integers with `runtime.kernels`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from runtime.kernels import library
from runtime.model.buffers import LayerBuffer
from runtime.model.contract import Step
from runtime.model.geometry import Geometry, RaySets, inverse
from runtime.model.job import Job
from runtime.model.targets import outside_codes, rest_of, target_table, without_alpha
from runtime.optics.stack import PanelStack
from runtime.records import I16, U8
from runtime.support.threads import on_rows, parallel_map

if TYPE_CHECKING:
    from runtime.kernels.compiled import Panels, Problem

WEIGHT, TAPER = 8191, 32767  # the number 1 in fixed point, in the targets' weights and in the tapers


class CpuBackend:
    """Backend that runs the solver on the processor. It is always available."""

    name = "cpu"
    context: object = None

    def state(self, stack: PanelStack, *, threads: int) -> CpuState:
        return CpuState(stack, threads=threads)

    def close(self) -> None:
        """Do nothing, because this backend holds no resources."""


class CpuState:
    """`SolverState` for the processor."""

    def __init__(self, stack: PanelStack, *, threads: int) -> None:
        self._stack, self._threads = stack, max(1, threads)
        self._panels: dict[int, Panels] = {}  # keyed by the number of channels

    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> AbstractContextManager[CpuSolution]:
        stack, channels = self._stack, job.channels
        if channels not in self._panels:
            self._panels[channels] = library().Panels(stack.count, stack.height_px, stack.width_px, channels)
        return nullcontext(CpuSolution(self._panels[channels], job, geometry, threads=self._threads, resumed=resumed))

    def close(self) -> None:
        self._panels = {}


class CpuSolution:
    """`OpenSolution` for the processor."""

    def __init__(self, panels: Panels, job: Job, geometry: Geometry, *, threads: int, resumed: bool) -> None:
        self._held, self._geometry, self._stack = panels, geometry, job.stack
        self._channels, self._sigma_m, self._threads = job.channels, job.eye_sigma_m, threads
        self._rest = rest_of(job.stack.count)
        self._resting = set() if resumed else set(range(job.stack.count))
        seen = [view.pixels[geometry.rays.slices] for view in job.views]
        self._rays = library().Rays(
            parallel_map(lambda picture: without_alpha(picture, job.channels), seen),
            *(np.rint(TAPER * taper).astype(np.int16) for taper in geometry.tapers()),
            _packed_table(job.stack.count), rest=self._rest, missing=geometry.missing_weight,
        )  # fmt: skip

    def set_panel(self, panel: int, codes: I16) -> None:
        if self._stack.is_grey(panel) and self._channels == 3:
            codes = np.repeat(codes.mean(axis=2, keepdims=True).astype(np.int16), 3, axis=2)
        self._held.set(panel, np.ascontiguousarray(codes))
        self._resting.discard(panel)

    def panel(self, panel: int) -> I16:
        box = self._geometry.boxes[panel]
        return np.array(self._held.values(panel, box.height_px, box.width_px), np.int16)

    def close_middle(self) -> None:
        self._resting.discard(self._geometry.middle)  # every pixel is written below
        self._rest_others()
        problem = self._problem(self._geometry.closing_sets(), closing=True)
        self._in_parts(problem.close_middle)

    def start(self) -> None:
        self._rest_others()
        self._held.start()

    def step(self, step: Step) -> None:
        problem = self._problem(self._geometry.ray_sets(step.places, self._sigma_m), closing=False)
        self._in_parts(lambda part, parts: problem.step(step.size, step.momentum, step.floor, part, parts))
        self._held.advance()

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        self._rest_others()
        geometry, held, layers = self._geometry, self._held, buffer.pixels
        if outside is None:
            buffer.outside = None
        elif buffer.outside != (key := (outside, geometry.boxes, geometry.kept)):
            for n, layer in enumerate(layers):  # write whole pixels rather than components
                pixel = np.array([*outside_codes(self._stack.count, n, outside), 255], np.uint8)
                layer.view(np.uint32)[..., 0] = pixel.view(np.uint32)[0]
            buffer.outside = key
        for n, box in enumerate(geometry.boxes):
            kept = geometry.kept if n == geometry.middle else box
            if not kept.width_px or not kept.height_px:
                continue
            first, pixels = (kept.v0 - box.v0, kept.u0 - box.u0), layers[n][kept.slices]

            def show(begin: int, end: int, n: int = n, at: tuple[int, int] = first, pixels: U8 = pixels) -> None:
                held.write(n, *at, pixels, begin, end)

            on_rows(show, kept.height_px, threads=self._threads)

    def _rest_others(self) -> None:
        """Reset to the rest value all panels that have not been set."""
        for n in self._resting:
            box = self._geometry.boxes[n]
            self._held.fill(n, box.height_px, box.width_px, self._rest)
        self._resting.clear()

    def _in_parts(self, work: Callable[[int, int], None]) -> None:
        parallel_map(lambda part: work(part, self._threads), range(self._threads))

    def _problem(self, sets: RaySets, *, closing: bool) -> Problem:
        """Return the problem for the compiled loops. `closing` is True to close the middle panel, False for a step."""
        stack, boxes = self._stack, self._geometry.boxes
        problem: Problem = library().Problem(
            self._held, self._rays, closing, [(box.height_px, box.width_px) for box in boxes],
            *(np.ascontiguousarray(x) for x in (sets.panels_from_rays, inverse(sets.panels_from_rays))),
            list(zip(sets.views, sets.turn, strict=True)), sets.turns, [stack.is_grey(n) for n in range(stack.count)],
        )  # fmt: skip
        return problem


@lru_cache(maxsize=8)
def _packed_table(panels: int) -> NDArray[np.int32]:
    """Return `target_table` as (256,) integers with the sum in the lower 16 bits and the weight above it."""
    sums, weights = np.rint(target_table(panels) * np.array((1, WEIGHT), np.float32)).astype(np.int32).T
    return np.asarray(sums + (weights << 16), np.int32)
