"""The levels that a time budget chooses from, and what each of them takes and shows on the present content."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any, Protocol, TypeVar

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.errors import FatalError, PhasestackError
from runtime.evaluation.displayed import displayed
from runtime.model.predictor import SHIPPED, Predictor
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_for, retina_view
from runtime.plan.levels import QualityLevel
from runtime.plan.predictors import LADDER
from runtime.plan.reduced import ladder_predictor
from runtime.records import F32, F64, U8

log = logging.getLogger("phasestack.budget")

T = TypeVar("T")
Rung = tuple[str, float]  # a model's name, and the share of the panels' columns and rows that it solves

SCALES = (1.0, 0.75, 0.5)  # of a model that isn't shipped: it has no lighter sister
REPEATS = 3
# Of `prepare`, `inference` and `finish` against balanced, about as on two cores at 1920x1080: a simulated clock
# must not depend on the machine.
SIMULATED_COST = {"best": 2.1, "balanced": 1.0, "fast": 0.7}
SOLVING = ("prepare", "inference", "finish")


class NoLongerAsked(PhasestackError):
    """The solver does not want to know any more."""


class Ask(Protocol):
    """Runs a call where content can be drawn, and answers with its result."""

    def __call__(self, call: Callable[[], T]) -> T: ...


@dataclass(frozen=True, slots=True)
class LevelHost:
    """What the solver's thread, which has the GL context, does for whoever measures levels or makes one ready."""

    ask: Ask
    surround: Callable[[Predictor], None]  # has the run's backend surround a model; only when asked
    release: Callable[[Predictor], None]  # closes a level there, sooner or later; from any thread


class SolverCalls:
    """`Ask` for other threads: the solver's thread, which has the GL context, serves one call between two steps."""

    def __init__(self) -> None:
        self._asked: queue.SimpleQueue[tuple[Callable[[], Any], queue.SimpleQueue[tuple[Any, Exception | None]]]] = (
            queue.SimpleQueue()
        )
        self._closed = threading.Event()

    def __call__(self, call: Callable[[], T]) -> T:
        """Raises NoLongerAsked, and whatever the call raises."""
        answers: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()
        self._asked.put((call, answers))
        while not self._closed.is_set():
            try:
                result, error = answers.get(timeout=0.1)
            except queue.Empty:
                continue
            if error is not None:
                raise error
            answer: T = result
            return answer
        raise NoLongerAsked("the solver has other things to do")

    def serve(self) -> None:
        """Run one call, where one waits."""
        try:
            call, answers = self._asked.get_nowait()
        except queue.Empty:
            return
        try:
            answers.put((call(), None))
        except Exception as error:  # it belongs to who asked
            answers.put((None, error))

    def close(self) -> None:
        """Nobody serves any more; who waits is told."""
        self._closed.set()


@dataclass(frozen=True, slots=True)
class Scenery:
    """What is drawn while a level is measured or made ready."""

    content: ContentSource
    eyes_m: F64  # (2, 3) left, right; frame `stack`
    time_ns: int
    stack: PanelStack
    fov_deg: float

    def solved(self, predictor: Predictor, host: LevelHost) -> tuple[U8, float]:
        """A model's layers of the present picture, and how many milliseconds drawing and solving took.

        Solved by whoever calls, while the loop goes on; a model whose backend needs the context, where that is.
        """
        if _needs_the_context(predictor):
            return host.ask(lambda: self._solved_here(predictor))
        images, drawing_ms = host.ask(lambda: self._pictures(predictor))
        begin_ns = perf_counter_ns()
        layers = predictor.predict(images, self.eyes_m).layers
        return layers, drawing_ms + (perf_counter_ns() - begin_ns) / 1e6

    def _solved_here(self, predictor: Predictor) -> tuple[U8, float]:
        begin_ns = perf_counter_ns()
        images = drawn_for(predictor, self.content, self.eyes_m, time_ns=self.time_ns)
        solved = predictor.predict(images, self.eyes_m)
        taken_ms = (perf_counter_ns() - begin_ns) / 1e6
        return solved.layers, taken_ms  # the loop reads nothing back

    def _pictures(self, predictor: Predictor) -> tuple[list[list[U8]], float]:
        """What a model wants to see (copies), and how many milliseconds drawing it took."""
        begin_ns = perf_counter_ns()
        images = drawn_for(predictor, self.content, self.eyes_m, time_ns=self.time_ns)
        taken_ms = (perf_counter_ns() - begin_ns) / 1e6
        return [[image.copy() for image in eye] for eye in images], taken_ms

    def wanted(self) -> list[F32]:
        """Both eyes' own pictures, (h, w, 3) in [0, 1], of the panels' size."""
        pictures = []
        for side, eye_m in enumerate(self.eyes_m):
            size = {"width_px": self.stack.width_px, "height_px": self.stack.height_px}
            view = retina_view(eye_m, side, fov_deg=self.fov_deg, **size)
            picture = self.content.render(view, time_ns=self.time_ns)[..., :3]
            pictures.append(picture.astype(np.float32) / np.float32(255))
        return pictures

    def psnr_db(self, layers: U8, wanted: list[F32]) -> float:
        """Displayed PSNR of layers, both eyes pooled."""
        eye_views = displayed(layers, wanted, self.stack, eyes_m=self.eyes_m, fov_deg=self.fov_deg, similarity=False)
        return eye_views.quality.psnr_db


def rungs(settings: Settings, stack: PanelStack) -> tuple[Rung, ...]:
    """What a budget may choose from: the shipped models' ladder, or the configured model at fewer pixels."""
    if settings.model.name in SHIPPED and stack.count == 3 and stack.is_evenly_spaced:
        return LADDER
    return tuple((settings.model.name, scale) for scale in SCALES)


def ready_level(rung: Rung, settings: Settings, scenery: Scenery, host: LevelHost) -> Predictor:
    """A level's predictor that has drawn and solved the present picture, surrounded by the run's backend: its first
    frame costs no more than others.

    Raises PhasestackError.
    """
    predictor = ladder_predictor(*rung, scenery.stack, settings)
    try:
        host.ask(lambda: host.surround(predictor))
        if _needs_the_context(predictor):
            host.ask(lambda: predictor.warm_up(scenery.eyes_m))
        else:
            predictor.warm_up(scenery.eyes_m)
        scenery.solved(predictor, host)
    except BaseException:
        host.release(predictor)
        raise
    return predictor


def measured_levels(
    settings: Settings,
    scenery: Scenery,
    host: LevelHost,
    *,
    simulated: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> list[QualityLevel]:
    """What each level takes and how well it shows the present picture; those that can't be had are left out.

    simulated: times are the simulated clock's instead of the machine's. Raises FatalError where none can be had.
    """
    wanted = host.ask(scenery.wanted)
    levels: list[QualityLevel] = []
    for rung in rungs(settings, scenery.stack):
        level = QualityLevel(*rung, 0.0, 0.0)
        tell(level.label)
        try:
            level = _measured(rung, settings, scenery, host, wanted, simulated=simulated)
        except FatalError as error:  # a network of fixed size has no smaller ones
            log.info("budget: %s is left out: %s", level.label, error)
            continue
        levels.append(level)
        log.info("budget: %s takes %.1f ms and shows %.1f dB", level.label, level.expected_ms, level.psnr_db)
    if not levels:
        raise FatalError("budget: no model can be had in any size")
    return levels


def _measured(
    rung: Rung, settings: Settings, scenery: Scenery, host: LevelHost, wanted: list[F32], *, simulated: bool
) -> QualityLevel:
    predictor = ready_level(rung, settings, scenery, host)
    try:
        tries = [scenery.solved(predictor, host) for _ in range(1 if simulated else REPEATS)]
        shown_db = scenery.psnr_db(tries[-1][0], wanted)
    finally:
        host.release(predictor)
    cost_ms = min(taken_ms for _, taken_ms in tries)  # the least disturbed: the loop may be at work meanwhile
    if simulated:
        cost_ms = sum(simulated_stage_ms(rung, settings)[stage] for stage in ("render", *SOLVING))
    return QualityLevel(*rung, cost_ms, shown_db)


def _needs_the_context(predictor: Predictor) -> bool:
    return predictor.backend == "gl"


def simulated_stage_ms(rung: Rung, settings: Settings) -> dict[str, float]:
    """What each stage costs on a simulated clock at one level; the configuration tells it for the configured model."""
    name, scale = rung
    pixels = scale * scale
    relative = SIMULATED_COST.get(name, 1.0) / SIMULATED_COST.get(settings.model.name, 1.0)
    factors = {"render": pixels} | dict.fromkeys(SOLVING, pixels * relative)
    stages = {"render": 0.0} | dict.fromkeys(SOLVING, 0.0) | settings.loop.simulated_stage_ms
    return {stage: cost * factors.get(stage, 1.0) for stage, cost in stages.items()}
