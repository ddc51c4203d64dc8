"""The unrolled solver: a network along the eyes' line, local corrections, and the centre panel in closed form.

`steps` says what is done in which order; a backend does all of it but the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.clock import Stopwatch
from runtime.errors import EyesNotServed, ModelFailure
from runtime.model.assembly import Assembly, Placed, Rest, Shared, Uniform
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.chain import chain_frame, chain_modes
from runtime.model.contract import Step
from runtime.model.cpu import CpuBackend
from runtime.model.fade import Fade
from runtime.model.job import Job, Picture
from runtime.model.reprojection import CENTRE, FRONT, REAR, visible_boxes
from runtime.model.session import ModelSession
from runtime.model.steps import Answer, Problem, SolverBackend, SolverState, run_steps
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, I16, Layers
from runtime.support.threads import at_once

HALF_IPD_M = 0.031
SIZES_KEPT = 8  # of parts, whose buffers stay from frame to frame


class UnrolledPredictor(Predictor):
    """Models of `input_frame` chain: three panels, evenly spaced or nearly so, any pose."""

    trims = True

    def __init__(
        self, session: ModelSession, stack: PanelStack, *, threads: int = 2, backend: SolverBackend | None = None
    ) -> None:
        """backend: who does what surrounds the network; None: the processor."""
        self.session, self.stack = session, stack
        self.name, self.provider = session.contract.name, session.provider
        self.parameters, self.fell_back = session.contract.parameters, session.fell_back
        self._backend: SolverBackend = backend or CpuBackend()
        self._threads = threads
        self._states: dict[tuple[int, int], SolverState] = {}  # by the size of what is solved
        self._assemblies: dict[tuple[int, int], Assembly] = {}

    def warm_up(self, eyes_m: F64) -> None:
        from runtime.model.compiled.panels import warm_up  # noqa: PLC0415 - other backends need none

        warm_up()  # whatever a later eye, scene or setting needs
        super().warm_up(eyes_m)

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self._backend.name

    def reads_textures_of(self, context: object) -> bool:
        return context is not None and self._backend.context is context

    def on_panels(self, stack: PanelStack) -> UnrolledPredictor:
        return UnrolledPredictor(self.session, stack, threads=self._threads)

    def set_backend(self, backend: SolverBackend) -> None:
        self.close()
        self._backend = backend

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return (self.stack.panel(CENTRE),)

    @property
    def interpolation(self) -> str:
        return self.session.contract.interpolation

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        return (visible_boxes(eyes_m, self.stack)[CENTRE].slices,)

    def solve(self, job: Job) -> Prediction:
        watch, part = Stopwatch(*STAGES), job.part
        pictures = [images[0] for images in job.pictures]
        if part is None:
            layers, steps = self._panels(job, pictures, self.stack, job.eyes_m, None, watch)
            return Prediction(layers, watch.stage_ms, steps)
        if part.colour is not None:
            rest: Rest = Uniform(part.colour)
        else:
            rest = Shared(job.arrays[0][0], self.session.contract.emphasis)
        window, steps = None, 0
        if part.box.width_px:
            if not part.drawn:
                whole = [images[0][part.box.slices] for images in job.arrays]
                pictures = [*at_once(np.ascontiguousarray, whole)]
            eyes_m = job.eyes_m - part.shift_m(self.stack)
            # Solved before anything is put together: where the model fails, the last good layers stay as they were.
            layers, steps = self._panels(job, pictures, part.stack(self.stack), eyes_m, part.fade(self.stack), watch)
            window = Placed(layers, part.box, part.kept)
        made = self._assembly(self.stack).assembled(rest, window)
        watch.lap("finish")
        return Prediction(made, watch.stage_ms, steps)

    @property
    def refining(self) -> tuple[Step, ...]:
        return self.session.contract.refining

    def close(self) -> None:
        for state in self._states.values():
            state.close()
        for assembly in self._assemblies.values():
            assembly.close()
        self._states, self._assemblies = {}, {}

    def _panels(
        self,
        job: Job,
        pictures: Sequence[Picture],
        stack: PanelStack,
        eyes_m: F64,
        fade: Fade | None,
        watch: Stopwatch,
    ) -> tuple[Layers, int]:
        """Layers of a stack, the whole or a part, for two pictures of its centre panel's pixels; and steps done."""
        across_m = np.abs(eyes_m[1] - eyes_m[0])
        if across_m[2] > across_m[1]:
            # Eyes above each other: the same problem with rows for columns. What was down (-z) is to the right (+y).
            assembly = self._assembly(stack)
            transposed_m = np.stack([eyes_m[:, 0], -eyes_m[:, 2], -eyes_m[:, 1]], axis=1)
            order = [0, 1] if transposed_m[1, 1] > transposed_m[0, 1] else [1, 0]
            pictures = [assembly.transposed_picture(pictures[side], side) for side in order]
            fade = fade and fade.transposed()
            layers, done = self._panels(job, pictures, stack.transposed(), transposed_m[order], fade, watch)
            return assembly.transposed(layers), done
        contract = self.session.contract
        # One eye that stands for both asks for no difference: the chain may run along any line.
        along_m = eyes_m if across_m.any() else eyes_m + HALF_IPD_M * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        try:
            frame = chain_frame(along_m, stack, cell_px=contract.cell_px, reduction=contract.reduction)
        except ValueError as error:
            raise EyesNotServed(str(error)) from None
        boxes = visible_boxes(eyes_m, stack)
        problem = Problem(contract, stack, boxes, eyes_m, frame, job.eye_sigma_mm, job.channels, fade)
        state = self._state(stack)
        with state.begin(pictures, problem):
            layers, done = run_steps(
                contract.steps,
                state,
                lambda residuals: self._network(residuals, problem, watch),
                deadline_ns=job.deadline_ns,
            )
        watch.lap("finish")
        return layers, done

    def _state(self, stack: PanelStack) -> SolverState:
        """Made when it is first needed, on the thread that uses it. Raises InputError where the stack is too large."""
        size = stack.width_px, stack.height_px
        state = self._states.pop(size, None) or self._backend.state(self.session.contract, stack, threads=self._threads)
        self._states[size] = state  # the newest last
        while len(self._states) > SIZES_KEPT:
            self._states.pop(next(iter(self._states))).close()
        return state

    def _assembly(self, stack: PanelStack) -> Assembly:
        size = stack.width_px, stack.height_px
        if size not in self._assemblies:
            self._assemblies[size] = self._backend.assembly(stack)
        return self._assemblies[size]

    def _network(self, residuals: tuple[I16, I16], problem: Problem, watch: Stopwatch) -> Answer:
        """The network's answer: both outer panels on the chain frame's raster, from one parallax before its first
        column, in fixed-point codes."""
        frame = problem.frame
        waves, shifted_waves, spectrum, modes_in = chain_modes(frame.cells)
        left, right = (image.reshape(frame.rows, frame.cells, -1) for image in residuals)
        feeds: dict[str, NDArray[Any]] = {
            "left": left,
            "right": right,
            "waves": waves,
            "shifted_waves": shifted_waves,
            "spectrum": spectrum,
            "modes_in": modes_in,
            "doubt": frame.eye_sigma_px(problem.stack, eye_sigma_mm=problem.eye_sigma_mm),
        }
        shape = (frame.rows, frame.cells + 1, left.shape[2])
        watch.lap("prepare")
        answer = self.session.run(feeds, {"rear": shape, "front": shape, "check": (1,)})
        if not np.isfinite(answer["check"]).all():
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        tail = residuals[0].shape[2:]
        panels = {n: answer[name].reshape(frame.rows, -1, *tail) for n, name in ((REAR, "rear"), (FRONT, "front"))}
        return problem.faded(panels)
