"""Solver. It gets a proposal for the outer panels, solves the middle panel, and then runs steps.

The algorithm is described in docs/mathematics.md. This module calls the operations in order, and the devices
(`cpu` and `gl`) implement them.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns

from runtime.clock import Stopwatch
from runtime.model.base import STAGES, Prediction, Predictor
from runtime.model.buffers import LayerBuffer, LayerPool, LayerSlots
from runtime.model.contract import Places, Step
from runtime.model.cpu import CpuBackend
from runtime.model.device import SolverBackend, SolverState
from runtime.model.geometry import Geometry
from runtime.model.job import Job
from runtime.model.proposal import Proposal
from runtime.optics.malus import rest_code
from runtime.optics.stack import PanelStack

_Done = tuple[int, int | None]  # number of steps, and how many of them earlier solutions made; None: not continued
REDUCTIONS = (1, 2, 3, 4)  # supported rasters, given as divisors of the display's rows and columns
REFINED_STEPS = 8  # a solution is continued for up to this many steps in total, as many as `best` has
REFINING = (Step(size=0.8, places="falling"), Step(size=0.8, places="rising"))  # alternate after the model's steps


def steps_from_even(steps: int) -> tuple[Step, ...]:
    """Return the steps to run without a network, starting from panels at the rest value.

    Args:
        steps: Number of steps that the model runs when it can start from its network's proposal.
    """
    in_turn: tuple[Places, ...] = ("rising", "middle", "falling", "middle")
    sizes = (1.2,) * (4 * steps) + (0.8,) * (3 * steps // 2)
    return tuple(Step(size=size, places=in_turn[n % 4]) for n, size in enumerate(sizes))


class StepPredictor(Predictor):
    """Model that runs steps starting from a network's proposal or from panels at the rest value."""

    def __init__(
        self,
        stack: PanelStack,
        proposal: Proposal | None,
        steps: Sequence[Step],
        *,
        name: str,
        threads: int = 2,
        backend: SolverBackend | None = None,
    ) -> None:
        """Create the model.

        Args:
            proposal: Network that makes the proposal to start from. If None, all panels start at the rest value.
            steps: Steps to run for a solution.
            name: Model name to show to the user.
            threads: Number of processor threads.
            backend: Device that runs everything except the network. By default, the processor.
        """
        self.stack, self.name, self._proposal, self._steps = stack, name, proposal, tuple(steps)
        self._steps_from_even = self._steps if proposal is None else steps_from_even(len(self._steps))
        self.provider, self.parameters, self._threads = "cpu", 0, threads
        if proposal is not None:
            contract = proposal.session.contract
            self.provider = proposal.session.provider
            self.parameters, self.precision = contract.parameters, contract.precision
        self.any_raster = proposal is None or proposal.any_raster
        self.trims = proposal is not None and proposal.any_raster
        self.reductions = REDUCTIONS if self.any_raster else (1,)
        self.steps = len(self._steps)
        self.refined_steps = max(self.steps, REFINED_STEPS)
        self._backend: SolverBackend = backend or CpuBackend()
        self._rasters: dict[PanelStack, tuple[SolverState, LayerPool]] = {}
        self._slots: LayerSlots | None = None
        # The newest solution's geometry, channels and number of steps; the state still holds its panels.
        self._improved: tuple[Geometry, int, int] | None = None

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self._backend.name

    def reads_textures_of(self, context: object) -> bool:
        return context is not None and self._backend.context is context

    def name_with(self, views: int) -> str:
        return (
            self.name if views == 2 or self._proposal is None else f"{self.name} (without its network: needs two views)"
        )

    def on_panels(self, stack: PanelStack) -> StepPredictor | None:
        if not self.any_raster:
            return None
        return StepPredictor(stack, self._proposal, self._steps, name=self.name, threads=self._threads)

    def set_backend(self, backend: SolverBackend) -> None:
        self.close()
        self._backend = backend

    def write_to(self, slots: LayerSlots) -> None:
        self.close()
        self._slots = slots

    def solve(self, job: Job, watch: Stopwatch | None = None) -> Prediction:
        watch = watch or Stopwatch(*STAGES)
        if job.stack not in self._rasters:
            state = self._backend.state(job.stack, threads=self._threads)
            self._rasters[job.stack] = state, LayerPool(job.stack, self._slots)
        state, pool = self._rasters[job.stack]
        buffer, rest, window = pool.take(), rest_code(job.stack.count), job.window
        done: _Done = 0, None
        if window is None:  # solve everything the eyes see, or all pixels if the network proposes whole panels
            geometry = job.targets.visible if self.any_raster else job.targets.every_pixel
            done = self._improve(job, geometry, state, buffer, watch, outside=rest)
        else:
            if window.colour is None or not window.box.width_px:  # fill with the picture that both eyes see
                self._improved = None
                with state.begin(job, job.targets.visible):
                    state.close_middle()
                    state.write(buffer, rest)
            if window.box.width_px:
                done = self._improve(job, job.targets.within(window), state, buffer, watch, outside=window.colour)
        watch.lap("finish")
        return Prediction(buffer.handed_over(), watch.stage_ms, job.savings, *done)

    def _improve(
        self,
        job: Job,
        geometry: Geometry,
        state: SolverState,
        buffer: LayerBuffer,
        watch: Stopwatch,
        *,
        outside: int | tuple[int, ...] | None,
    ) -> _Done:
        """Run steps starting from the proposal, or continue the previous solution if the rays are the same.

        The result is written to `buffer`.

        Args:
            outside: What to write to the middle panel outside its box (`SolverState.write`).
        """
        before = self._improved
        resumed = job.continued and before is not None and before[1] == job.channels and geometry.is_like(before[0])
        first = before[2] if before is not None and resumed else None
        self._improved, done = None, first or 0
        with state.begin(job, geometry, resumed=resumed):
            if not resumed:
                self._propose(job, geometry, state, watch)
            watch.lap("finish")
            steps = self._steps if self._is_proposed(job) else self._steps_from_even
            while done < (len(steps) if job.steps is None else job.steps):
                if job.deadline_ns is not None and perf_counter_ns() >= job.deadline_ns:
                    break
                state.step(steps[done] if done < len(steps) else REFINING[(done - len(steps)) % len(REFINING)])
                done += 1
            watch.lap("step")
            state.write(buffer, outside)
        self._improved = geometry, job.channels, done
        return done, first

    def _is_proposed(self, job: Job) -> bool:
        """Return True if the network proposes panels for a job, which must have one view for each of two eyes."""
        return self._proposal is not None and len(job.views) == 2 * job.targets.points

    def _propose(self, job: Job, geometry: Geometry, state: SolverState, watch: Stopwatch) -> None:
        proposed = {}
        if self._proposal is not None and self._is_proposed(job):
            proposed = self._proposal.panels(job, geometry, watch)
        for n, codes in proposed.items():
            state.set_panel(n, codes)
        if geometry.middle not in proposed:
            state.close_middle()
        state.start()

    def close(self) -> None:
        for state, _ in self._rasters.values():
            state.close()
        self._rasters, self._improved = {}, None
