"""Which backend does what surrounds the network: the one that was asked for, or the faster one here."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from runtime.errors import PhasestackError
from runtime.model.base import Predictor
from runtime.model.opencv_surround import OpenCvBackend
from runtime.model.schedule import Backend
from runtime.optics.stack import PanelStack
from runtime.records import U8

if TYPE_CHECKING:
    from runtime.model.gl.backend import GlBackend
    from runtime.support.gl_sharing import ShareGroup

log = logging.getLogger("phasestack.model")

EYES_M = ((0.6, -0.031, 0.0), (0.6, 0.031, 0.0))
FIRST_SHARE = 4  # the first look is at panels of so many times fewer columns and rows
CLEAR = 2.5  # times as fast there: no second look is needed
RUNS = 3  # timed, of which the fastest counts

Wanted = Literal["auto", "opencv", "gl"]


@dataclass(frozen=True, slots=True)
class Choice:
    """A backend, and why."""

    backend: Backend
    why: str  # one line, with what was measured


def choose(
    wanted: Wanted, predictor: Predictor, context: Callable[[], Any], *, group: ShareGroup | None = None
) -> Choice:
    """The backend for a model that is loaded. Tells the log what it found.

    context: an OpenGL context, current on this thread, asked for where one is needed; it may raise MissingPart.
    group: the context's, where solutions are shown from its textures.
    auto: whichever is faster here, whatever it is called; OpenCV where OpenGL can't be had or used.
    Raises MissingPart (gl without OpenGL), InputError (a panel too large for the driver), ModelFailure.
    """
    if predictor.on_panels(predictor.stack) is None:
        choice = Choice(OpenCvBackend(), f"{predictor.name} has no other")
    elif wanted == "opencv":
        choice = Choice(OpenCvBackend(), "as asked for")
    elif wanted == "gl":
        choice = Choice(_settled(_gl(context(), predictor.stack, group), predictor), "as asked for")
    else:
        choice = _faster(predictor, lambda: _gl(context(), predictor.stack, group))
    log.info("backend: %s (%s)", choice.backend.name, choice.why)
    return choice


def _gl(context: Any, stack: PanelStack, group: ShareGroup | None) -> GlBackend:
    from runtime.model.gl.backend import GlBackend

    return GlBackend(context, stack, group=group)


def _settled(backend: GlBackend, predictor: Predictor) -> GlBackend:
    """Its corrections in one pass or in two, whichever takes the GPU less time.

    A driver that copies slowly is not asked: one pass looks five times as often, and its program takes seconds to
    compile there.
    """
    from runtime.model.gl.programs import Account
    from runtime.model.gl.speed import measured_speed

    if measured_speed(backend.context).slow:
        return backend
    stack, took_ms = _smaller(predictor.stack, FIRST_SHARE), {}
    for at_once in (False, True):
        backend.at_once = at_once
        trial, found = _Trial(predictor, stack, backend), []
        try:
            trial.solve()
            for _ in range(RUNS):
                backend.passes.account = account = Account(timed=True)
                trial.solve()
                found.append(sum(one.gpu_ms or 0.0 for one in account.passes))
        finally:
            backend.passes.account = None
            trial.close()
        took_ms[at_once] = min(found)
    backend.at_once = took_ms[True] < took_ms[False]
    return backend


def _faster(predictor: Predictor, made: Callable[[], GlBackend]) -> Choice:
    opencv: Backend = OpenCvBackend()
    try:
        gl = made()
        for share, runs in ((FIRST_SHARE, RUNS), (1, 1)):
            stack = _smaller(predictor.stack, share)
            opencv_ms, gl_ms = (_solution_ms(predictor, stack, backend, runs=runs) for backend in (opencv, gl))
            found = f"{stack.width_px}x{stack.height_px}: opencv {opencv_ms:.1f} ms, gl {gl_ms:.1f} ms"
            if max(opencv_ms, gl_ms) > CLEAR * min(opencv_ms, gl_ms):
                break
        if gl_ms < opencv_ms:
            return Choice(_settled(gl, predictor), f"measured at {found}")
    except PhasestackError as error:
        return Choice(opencv, f"OpenGL can't be used: {error}")
    gl.close()
    return Choice(opencv, f"measured at {found}")


def _smaller(stack: PanelStack, share: int) -> PanelStack:
    width_px, height_px = (max(64, size // share) for size in (stack.width_px, stack.height_px))
    return replace(stack, width_px=width_px, height_px=height_px)


def _solution_ms(predictor: Predictor, stack: PanelStack, backend: Backend, *, runs: int) -> float:
    """What one solution takes, the fastest of a few; the first, which compiles and allocates, does not count."""
    trial = _Trial(predictor, stack, backend)
    try:
        trial.solve()
        times = []
        for _ in range(runs):
            begin_ns = perf_counter_ns()
            trial.solve()
            times.append((perf_counter_ns() - begin_ns) / 1e6)
    finally:
        trial.close()
    return min(times)


class _Trial:
    """A model on some panels, with pictures of which nothing can be left out."""

    def __init__(self, predictor: Predictor, stack: PanelStack, backend: Backend) -> None:
        made = predictor.on_panels(stack)
        assert made is not None
        made.surround_with(backend)
        self._predictor, self._eyes_m = made, np.array(EYES_M)
        self._pictures = [[_picture(stack, seed)] for seed in (0, 1)]

    def solve(self) -> None:
        """For two points: what an unsure eye costs besides is the same for all."""
        self._predictor.predict(self._pictures, self._eyes_m, eye_sigma_mm=0.0)

    def close(self) -> None:
        self._predictor.close()


def _picture(stack: PanelStack, seed: int) -> U8:
    """(h, w, 4) coloured noise: nothing of it can be left out."""
    noise = np.random.default_rng(seed).integers(0, 256, (stack.height_px, stack.width_px, 4), np.uint8)
    noise[..., 3] = 255
    return noise
