"""Solver backend for the processor. It updates panels of 16-bit integers with `runtime.kernels`."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from ctypes import byref, c_int32, c_void_p
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.kernels import MARGIN, MAX_SETS, KernelImage, Panel, Problem, library, with_margin
from runtime.model.buffers import LayerBuffer
from runtime.model.contract import Step
from runtime.model.geometry import Geometry, RaySets, inverse
from runtime.model.job import Job
from runtime.model.targets import outside_codes, rest_of, target_table, without_alpha
from runtime.optics.stack import PanelStack
from runtime.records import I16
from runtime.support.threads import on_rows, parallel_map

WEIGHT, TAPER = 8191, 32767  # the number 1 in fixed point, in the targets' weights and in the tapers
SAFE = 4 * MARGIN  # extra elements after a panel's rows, because whole vectors are read past the end of a row


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
        self._rest = rest_of(stack.count)
        self._buffers: dict[int, _Buffers] = {}  # keyed by the number of channels

    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> AbstractContextManager[None]:
        self._geometry, self._channels, self._sigma_m = geometry, job.channels, job.eye_sigma_m
        if job.channels not in self._buffers:
            self._buffers[job.channels] = _Buffers(self._stack, job.channels)
        self._held = self._buffers[job.channels]
        seen = [view.pixels[geometry.rays.slices] for view in job.views]
        self._targets = parallel_map(lambda picture: without_alpha(picture, job.channels), seen)
        across, down = geometry.tapers()
        columns: I16 = with_margin((len(across) * job.channels,), np.int16)
        columns[:] = np.rint(TAPER * np.repeat(across, job.channels))
        self._tapers = columns, np.rint(TAPER * down).astype(np.int16)
        self._resting = set() if resumed else set(range(self._stack.count))
        return nullcontext()

    def set_panel(self, panel: int, codes: I16) -> None:
        box, channels = self._geometry.boxes[panel], self._channels
        if self._stack.is_grey(panel) and channels == 3:
            codes = np.repeat(codes.mean(axis=2, keepdims=True).astype(np.int16), 3, axis=2)
        self._held.last[panel, : box.height_px, : box.width_px * channels] = codes.reshape(box.height_px, -1)
        self._resting.discard(panel)

    def close_middle(self) -> None:
        self._resting.discard(self._geometry.middle)  # every pixel is written below
        self._rest_others()
        held = self._held
        problem, _keep = self._problem(self._geometry.closing_sets(), ahead=held.ahead, last=held.last)
        self._in_parts(library().close_middle, problem)

    def start(self) -> None:
        self._rest_others()
        self._starts = True

    def step(self, step: Step) -> None:
        held = self._held
        # Rays may still read a row after it has been updated. The first step reads `last`, so it writes to other
        # memory.
        ahead, last = (held.last, held.ahead) if self._starts else (held.ahead, held.last)
        sets = self._geometry.ray_sets(step.places, self._sigma_m)
        problem, _keep = self._problem(sets, ahead=ahead, last=last)
        problem.size, problem.momentum, problem.floor = step.size, step.momentum, step.floor
        self._in_parts(library().step, problem)
        held.last, held.ahead, held.moved, self._starts = last, held.moved, ahead, False

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        self._rest_others()
        geometry, loops, layers = self._geometry, library(), buffer.pixels
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
            first = self._held.last[n, kept.v0 - box.v0 :, (kept.u0 - box.u0) * self._channels :]
            image = KernelImage.of(first, rows=kept.height_px, width=kept.width_px)
            pixels = layers[n].view(np.uint32)[kept.v0 :, kept.u0 :, 0]

            def show(first: int, end: int, image: KernelImage = image, pixels: NDArray[Any] = pixels) -> None:
                loops.show(byref(image), self._channels, pixels.ctypes.data, self._stack.width_px, first, end)

            on_rows(show, kept.height_px, threads=self._threads)

    def close(self) -> None:
        self._buffers = {}

    def _rest_others(self) -> None:
        """Reset to the rest value all panels that have not been set."""
        for n in self._resting:
            box = self._geometry.boxes[n]
            self._held.last[n, : box.height_px, : box.width_px * self._channels] = self._rest
        self._resting.clear()

    def _in_parts(self, work: Any, problem: Problem) -> None:
        parallel_map(lambda part: work(byref(problem), part, self._threads), range(self._threads))

    def _problem(self, sets: RaySets, *, ahead: I16, last: I16) -> tuple[Problem, object]:
        """Return the arguments for the compiled loops, and the arrays to keep alive during the call."""
        geometry, held, channels = self._geometry, self._held, self._channels
        seen, back = (np.ascontiguousarray(x) for x in (sets.panels_from_rays, inverse(sets.panels_from_rays)))
        if len(seen) > MAX_SETS:
            raise ValueError(f"there are {len(seen)} sets of rays, but the kernels accept at most {MAX_SETS}")
        table = _packed_table(self._stack.count)
        problem = Problem(
            panels=self._stack.count, sets=len(seen), channels=channels,
            height=geometry.rays.height_px // sets.turns, width=geometry.rays.width_px,
            turns=sets.turns, turn=(c_int32 * MAX_SETS)(*sets.turn),
            panels_from_rays=seen.ctypes.data, rays_from_panels=back.ctypes.data,
            targets=(c_void_p * MAX_SETS)(*(self._targets[view].ctypes.data for view in sets.views)),
            column_taper=self._tapers[0].ctypes.data, row_taper=self._tapers[1].ctypes.data,
            table=table.ctypes.data, rest=self._rest, missing=geometry.missing_weight,
        )  # fmt: skip
        for n, box in enumerate(geometry.boxes):
            problem.grey[n] = self._stack.is_grey(n)
            images = ahead[n], held.moved[n], held.last[n], last[n]
            problem.panel[n] = Panel(
                *(KernelImage.of(image, rows=box.height_px, width=box.width_px) for image in images)
            )
        return problem, (seen, back, table)


@lru_cache(maxsize=8)
def _packed_table(panels: int) -> NDArray[np.int32]:
    """Return `target_table` as (256,) integers with the sum in the lower 16 bits and the weight above it."""
    sums, weights = np.rint(target_table(panels) * np.array((1, WEIGHT), np.float32)).astype(np.int32).T
    return np.asarray(sums + (weights << 16), np.int32)


class _Buffers:
    """The panels' values between steps, for one number of channels.

    Each panel's box is stored starting at the first row and element.
    """

    def __init__(self, stack: PanelStack, channels: int) -> None:
        shape = (stack.count, stack.height_px + 1, stack.width_px * channels + SAFE)
        self.last, self.ahead, self.moved = (np.zeros(shape, np.int16) for _ in range(3))
