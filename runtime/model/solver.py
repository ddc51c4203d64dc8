"""Solver. It gets a proposal for the outer panels, solves the middle panel, and then runs steps.

The algorithm is described in docs/mathematics.md. This module calls the operations in order, and the devices
(`cpu` and `gl`) implement them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter_ns

import cv2
import numpy as np

from runtime.clock import Stopwatch
from runtime.kernels import FULL
from runtime.model.base import STAGES, ModelFacts, Prediction, Predictor
from runtime.model.buffers import LayerBuffer, LayerPool, LayerSlots
from runtime.model.contract import Places, Step
from runtime.model.cpu import CpuBackend
from runtime.model.device import OpenSolution, SolverBackend, SolverState
from runtime.model.geometry import Geometry
from runtime.model.job import Job
from runtime.model.proposal import Proposal, tapered
from runtime.optics.malus import rest_code
from runtime.optics.stack import PanelStack
from runtime.records import F32, I16

COARSE = ((8, 16), (4, 16), (2, 12))  # without a network: divisors of the first rasters, and steps on each
COARSE_SIZE = 1.3  # size of these steps
COARSE_LEAST_PX = 32  # minimum rows and columns of a raster
REDUCTIONS = (1, 2, 3, 4)  # supported rasters, given as divisors of the display's rows and columns
FOCUS_STEPS = 16  # steps of a solution with focus; fewer gain half as much on the retina, and more no more
REFINED_STEPS = 8  # a solution is continued for up to this many steps in total, as many as `best` has
IN_TURN: tuple[Places, ...] = ("rising", "middle", "falling", "middle")
REFINING = (Step(size=0.8, places="falling"), Step(size=0.8, places="rising"))  # alternate after the model's steps


def steps_from_even(steps: int) -> tuple[Step, ...]:
    """Return the steps to run without a network, instead of `steps`, from coarser rasters."""
    sizes = (1.2,) * (2 * steps) + (0.8,) * steps
    return tuple(Step(size=size, places=IN_TURN[n % 4]) for n, size in enumerate(sizes))


def steps_for_focus() -> tuple[Step, ...]:
    """Return the steps for points of the pupils, whose two halves take turns."""
    last = FOCUS_STEPS - 1
    return tuple(Step(size=1.3 - 0.5 * n / last, places=("rising", "falling")[n % 2]) for n in range(FOCUS_STEPS))


def enlarged(codes: I16, n: int, coarse: Geometry, geometry: Geometry) -> I16:
    """Resample a panel's values (rows, columns[, 3]) from a coarser geometry's box to a finer one's."""
    of, box = coarse.boxes[n], geometry.boxes[n]
    across, down = coarse.stack.width_px / geometry.stack.width_px, coarse.stack.height_px / geometry.stack.height_px
    # Positions are from the centre of the first pixel, as in OpenCV.
    matrix = np.array([
        [across, 0.0, across * (box.u0 + 0.5) - of.u0 - 0.5],
        [0.0, down, down * (box.v0 + 0.5) - of.v0 - 0.5],
    ])  # fmt: skip
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = box.width_px, box.height_px
    return np.asarray(cv2.warpAffine(codes, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.int16)


@dataclass(frozen=True, slots=True)
class _Improved:
    """Outcome of `_improve`."""

    steps: int  # including those of the solutions that it continued
    continued_from: int | None = None  # how many of these earlier solutions made; None: none was continued
    floats: F32 | None = None  # the layers before rounding, if they were asked for


def _unrounded(buffer: LayerBuffer, geometry: Geometry, solving: OpenSolution) -> F32:
    """Return the layers just written to a buffer, without rounding: (N, rows, columns, 3) in [0, 1]."""
    layers = buffer.pixels[..., :3].astype(np.float32) / np.float32(255)
    for n, box in enumerate(geometry.boxes):
        layers[n][box.slices] = solving.panel(n).astype(np.float32) / np.float32(FULL)
    return layers


class StepPredictor(Predictor):
    """Model that runs steps starting from a network's proposal or from coarser rasters (`COARSE`)."""

    def __init__(
        self,
        stack: PanelStack,
        proposal: Proposal | None,
        steps: Sequence[Step],
        *,
        name: str,
        threads: int = 2,
        backend: SolverBackend | None = None,
        slots: LayerSlots | None = None,
    ) -> None:
        """Create a model that is shown to the user as `name`, by default on the processor. Without a proposal, the
        panels to start from are solved on coarser rasters. Layers are written to `slots`, if given.
        """
        self.stack, self._proposal, self._steps, self._threads = stack, proposal, tuple(steps), threads
        self._steps_from_even = self._steps if proposal is None else steps_from_even(len(self._steps))
        self._any_raster = proposal is None or proposal.any_raster
        self.facts = ModelFacts(
            name,
            "cpu" if proposal is None else proposal.session.provider,
            0 if proposal is None else proposal.session.contract.parameters,
            "fp32" if proposal is None else proposal.session.contract.precision,
            has_devices=self._any_raster,
            trims=proposal is not None and proposal.any_raster,
            reductions=REDUCTIONS if self._any_raster else (1,),
            steps=len(self._steps),
            refined_steps=max(len(self._steps), REFINED_STEPS),
        )
        self._backend: SolverBackend = backend or CpuBackend()
        self._states: dict[PanelStack, SolverState] = {}
        self._pools: dict[PanelStack, LayerPool] = {}
        self._slots = slots
        # The newest solution's geometry, channels and number of steps; the state still holds its panels.
        self._improved: tuple[Geometry, int, int] | None = None

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self._backend.name

    def reads_textures_of(self, context: object) -> bool:
        return context is not None and self._backend.context is context

    def name_with(self, views: int) -> str:
        served = views == 2 or self._proposal is None
        return self.facts.name if served else f"{self.facts.name} (without its network: needs two views)"

    def bound(
        self, *, backend: SolverBackend | None = None, stack: PanelStack | None = None, slots: LayerSlots | None = None
    ) -> StepPredictor:
        return StepPredictor(
            stack or self.stack, self._proposal, self._steps, name=self.facts.name, threads=self._threads,
            backend=backend or self._backend, slots=slots or self._slots,
        )  # fmt: skip

    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        watch = watch or Stopwatch(*STAGES)
        state = self._state(job.stack)
        if job.stack not in self._pools:
            self._pools[job.stack] = LayerPool(job.stack, self._slots)
        pool = self._pools[job.stack]
        buffer, rest, window = pool.take(), rest_code(job.stack.count), job.window
        done = _Improved(0)
        if window is None:  # solve everything the eyes see, or all pixels if the network proposes whole panels
            geometry = job.targets.visible if self._any_raster else job.targets.every_pixel
            done = self._improve(job, geometry, state, buffer, watch, outside=rest)
        else:
            if window.colour is None or not window.box.width_px:  # fill with the picture that both eyes see
                self._improved = None
                with state.begin(job, job.targets.visible) as solving:
                    solving.close_middle()
                    solving.write(buffer, rest)
            if window.box.width_px:
                done = self._improve(job, job.targets.within(window), state, buffer, watch, outside=window.colour)
        watch.lap("finish")
        layers = buffer.handed_over()
        return Prediction(layers, watch.stage_ms, job.savings, done.floats, done.steps, done.continued_from)

    def _improve(
        self,
        job: Job,
        geometry: Geometry,
        state: SolverState,
        buffer: LayerBuffer,
        watch: Stopwatch,
        *,
        outside: int | tuple[int, ...] | None,
    ) -> _Improved:
        """Run steps from the proposal, or the previous solution if the rays are the same, and write to `buffer`."""
        before = self._improved
        resumed = job.continued and before is not None and before[1] == job.channels and geometry.is_like(before[0])
        first = before[2] if before is not None and resumed else None
        self._improved, done = None, first or 0
        proposed: dict[int, I16] = {}
        if not resumed:
            proposed = self._proposed(job, geometry, watch)
        with state.begin(job, geometry, resumed=resumed) as solving:
            if not resumed:
                self._begin(proposed, geometry, solving)
            watch.lap("finish")
            steps = self._steps if self._is_proposed(job) else self._steps_from_even
            if job.targets.points > 1:
                steps = steps_for_focus()
            while done < (len(steps) if job.steps is None else job.steps):
                if job.deadline_ns is not None and perf_counter_ns() >= job.deadline_ns:
                    break
                solving.step(steps[done] if done < len(steps) else REFINING[(done - len(steps)) % len(REFINING)])
                done += 1
            watch.lap("step")
            solving.write(buffer, outside)
            floats = _unrounded(buffer, geometry, solving) if job.floats and job.window is None else None
        self._improved = geometry, job.channels, done
        return _Improved(done, first, floats)

    def _state(self, stack: PanelStack) -> SolverState:
        if stack not in self._states:
            self._states[stack] = self._backend.state(stack, threads=self._threads)
        return self._states[stack]

    def _is_proposed(self, job: Job) -> bool:
        """Return True if the network proposes panels for a job, which must have one view for each of two eyes."""
        return self._proposal is not None and len(job.views) == 2 * job.targets.points

    def _proposed(self, job: Job, geometry: Geometry, watch: Stopwatch) -> dict[int, I16]:
        """Return the panels to start from: the network's, or those solved on coarser rasters."""
        if self._proposal is not None and self._is_proposed(job):
            return dict(self._proposal.panels(job, geometry, watch))
        proposed: dict[int, I16] = {}
        solved: Geometry | None = None
        for reduction, steps in COARSE:
            stack = job.stack.reduced(reduction)
            if min(stack.width_px, stack.height_px) < COARSE_LEAST_PX:
                continue
            targets = job.targets.on_raster(reduction)
            coarse, state = replace(job, targets=targets, window=None), self._state(stack)
            with state.begin(coarse, targets.visible) as solving:
                if solved is not None:
                    proposed = {n: enlarged(codes, n, solved, targets.visible) for n, codes in proposed.items()}
                self._begin(proposed, targets.visible, solving)
                for n in range(steps):
                    solving.step(Step(size=COARSE_SIZE, places=IN_TURN[n % len(IN_TURN)]))
                proposed, solved = {n: solving.panel(n) for n in range(stack.count)}, targets.visible
        watch.lap("step")
        if solved is None:
            return {}
        return {n: tapered(enlarged(codes, n, solved, geometry), n, geometry) for n, codes in proposed.items()}

    def _begin(self, proposed: dict[int, I16], geometry: Geometry, solving: OpenSolution) -> None:
        for n, codes in proposed.items():
            solving.set_panel(n, codes)
        if geometry.middle not in proposed:
            solving.close_middle()
        solving.start()

    def close(self) -> None:
        for state in self._states.values():
            state.close()
        self._states, self._pools, self._improved = {}, {}, None
