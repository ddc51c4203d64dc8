"""Choose the backend to run the solver on: the configured one or, for `auto`, the faster one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from runtime.errors import PhasestackError
from runtime.model.base import Predictor, trial_eyes_m
from runtime.model.job import drawn_job
from runtime.optics.stack import PanelStack
from runtime.records import U8

if TYPE_CHECKING:
    from runtime.model.device import SolverBackend
    from runtime.model.gl.state import GlBackend

log = logging.getLogger("phasestack.model")

FIRST_SHARE = 4  # the first comparison divides the panels' columns and rows by this
CLEAR = 2.5  # a backend that is this many times as fast in the first comparison wins without a second one
RUNS = 3  # timed runs; the fastest counts

Wanted = Literal["auto", "cpu", "gl"]


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen backend, and the reason for choosing it."""

    backend: SolverBackend
    why: str  # one line, including the times if they were measured


def choose(wanted: Wanted, predictor: Predictor, context: Callable[[], Any]) -> Choice:
    """Choose a backend for a loaded model, and log the reason. `auto` times both; without OpenGL, it is
    the processor. `context` returns an OpenGL context current on this thread or raises MissingPart; it is called only
    if needed. If `wanted` is `gl`, raises MissingPart without OpenGL, and InputError if a panel is too large for its
    driver.
    """
    if not predictor.facts.has_devices:
        choice = Choice(_cpu(), f"the only backend that supports {predictor.facts.name}")
    elif wanted == "cpu":
        choice = Choice(_cpu(), "as configured")
    elif wanted == "gl":
        choice = Choice(_gl(context(), predictor.stack), "as configured")
    else:
        choice = _faster(predictor, lambda: _gl(context(), predictor.stack))
    log.info("backend: %s (%s)", choice.backend.name, choice.why)
    return choice


def _cpu() -> SolverBackend:
    from runtime.model.cpu import CpuBackend

    return CpuBackend()


def _gl(context: Any, stack: PanelStack) -> GlBackend:
    from runtime.model.gl.state import GlBackend

    return GlBackend(context, stack)


def _faster(predictor: Predictor, made: Callable[[], GlBackend]) -> Choice:
    cpu = _cpu()
    try:
        gl = made()
    except PhasestackError as error:
        return Choice(cpu, f"OpenGL is not available: {error}")
    used = cpu
    try:
        for share, runs in ((FIRST_SHARE, RUNS), (1, 1)):
            width_px, height_px = (max(64, px // share) for px in (predictor.stack.width_px, predictor.stack.height_px))
            stack = replace(predictor.stack, width_px=width_px, height_px=height_px)
            times_ms = []
            for used in (cpu, gl):
                times_ms.append(solution_ms(predictor, stack, used, runs=runs))
            cpu_ms, gl_ms = times_ms
            times = f"{stack.width_px}x{stack.height_px}: cpu {cpu_ms:.1f} ms, gl {gl_ms:.1f} ms"
            if max(cpu_ms, gl_ms) > CLEAR * min(cpu_ms, gl_ms):
                break
        if gl_ms < cpu_ms:
            return Choice(gl, f"the faster at {times}")
        why = f"the faster at {times}"
    except PhasestackError as error:
        why = f"a solution on {used.name} failed: {error}"
    gl.close()
    return Choice(cpu, why)


def solution_ms(predictor: Predictor, stack: PanelStack, backend: SolverBackend, *, runs: int) -> float:
    """Return the time of the fastest of `runs` solutions, in ms, after an untimed one."""
    solver = predictor.bound(stack=stack, backend=backend)
    # Assume that the eyes are known exactly, because a tracking error adds the same time on every backend.
    job = replace(drawn_job([_noise(stack, seed) for seed in (0, 1)], trial_eyes_m(stack), stack), eye_sigma_m=0.0)
    try:
        solver.solve(job)
        times = []
        for _ in range(runs):
            begin_ns = perf_counter_ns()
            solver.solve(job)
            times.append((perf_counter_ns() - begin_ns) / 1e6)
    finally:
        solver.close()
    return min(times)


def _noise(stack: PanelStack, seed: int) -> U8:
    """Return an (h, w, 4) picture of coloured noise, which leaves no work for the solver to skip."""
    noise = np.random.default_rng(seed).integers(0, 256, (stack.height_px, stack.width_px, 4), np.uint8)
    noise[..., 3] = 255
    return noise
