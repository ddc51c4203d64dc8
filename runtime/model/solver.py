"""The solver: a network's proposal, the middle panel closed, steps (docs/mathematics.md).

A device (`cpu`, `gl`) does single steps; their order is here.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns

from runtime.clock import Stopwatch
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.contract import Step
from runtime.model.cpu import CpuBackend
from runtime.model.device import SolverBackend, SolverState
from runtime.model.geometry import Geometry, geometry_of
from runtime.model.job import Job
from runtime.model.network import PictureProposal
from runtime.model.proposal import ChainProposal
from runtime.optics.malus import rest_code
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64


class StepPredictor(Predictor):
    """Steps from a network's proposal, or from even panels: any stack, any pose."""

    def __init__(
        self,
        stack: PanelStack,
        proposal: ChainProposal | PictureProposal | None,
        steps: Sequence[Step],
        *,
        name: str,
        threads: int = 2,
        backend: SolverBackend | None = None,
    ) -> None:
        """proposal: None: panels begin even; backend: None: the processor."""
        self.stack, self.name, self._proposal, self._steps = stack, name, proposal, tuple(steps)
        self.provider, self.parameters, self._threads = "cpu", 0, threads
        if proposal is not None:
            session = proposal.session
            self.provider, self.parameters = session.provider, session.contract.parameters
            self.precision, self.fell_back = session.contract.precision, session.fell_back
        self.trims = isinstance(proposal, ChainProposal)
        self.needs_rasters = isinstance(proposal, PictureProposal)
        self.black_beside = isinstance(proposal, PictureProposal) and proposal.black_beside
        self._backend: SolverBackend = backend or CpuBackend()
        self._state: SolverState | None = None

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self._backend.name

    def reads_textures_of(self, context: object) -> bool:
        return context is not None and self._backend.context is context

    def on_panels(self, stack: PanelStack) -> StepPredictor | None:
        if isinstance(self._proposal, PictureProposal) or stack.count != 3:
            return None
        return StepPredictor(stack, self._proposal, self._steps, name=self.name, threads=self._threads)

    def set_backend(self, backend: SolverBackend) -> None:
        self.close()
        self._backend = backend

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        if isinstance(self._proposal, PictureProposal):
            return self._proposal.rasters
        return (self.stack.panel(self.stack.count // 2),)

    def solve(self, job: Job) -> Prediction:
        rest = rest_code(self.stack.count)
        watch, part, beside = Stopwatch(*STAGES), job.part, (rest if job.part is None else job.part.colour)
        if self._state is None:
            self._state = self._backend.state(self.stack, threads=self._threads)
        state, steps, layers = self._state, 0, None
        if part is not None and beside is None:  # beside the window both eyes see one picture
            with state.begin(job, geometry_of(job, self.stack, whole=True)):
                state.close_middle()
                layers = state.write(rest)
        if part is None or part.box.width_px or layers is None:
            # Of a network of whole pictures all that it answers is shown.
            geometry = geometry_of(job, self.stack, unseen=self.needs_rasters)
            with state.begin(job, geometry):
                if part is None or part.box.width_px:
                    steps = self._solve(job, geometry, state, watch)
                layers = state.write(beside)
        watch.lap("finish")
        return Prediction(layers, watch.stage_ms, steps)

    def _solve(self, job: Job, geometry: Geometry, state: SolverState, watch: Stopwatch) -> int:
        """Steps done, the network counted."""
        proposed = {} if self._proposal is None else self._proposal.panels(job, geometry, watch)
        for n, codes in proposed.items():
            state.set_panel(n, codes)
        if geometry.middle not in proposed:
            state.close_middle()
        state.start()
        for done, step in enumerate(self._steps, 1):
            if job.deadline_ns is not None and perf_counter_ns() >= job.deadline_ns:
                return done
            state.step(step)
        return 1 + len(self._steps)

    def close(self) -> None:
        if self._state is not None:
            self._state.close()
        self._state = None
