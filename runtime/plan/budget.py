"""The time budget of a running solver: measures levels, keeps the next ones ready, switches between two solutions."""

from __future__ import annotations

import logging
import queue
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import asdict, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.errors import PhasestackError
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.plan.ladder import (
    Ask,
    LevelHost,
    NoLongerAsked,
    Rung,
    Scenery,
    SolverCalls,
    measured_levels,
    ready_level,
    simulated_stage_ms,
)
from runtime.plan.levels import BudgetKeeper, QualityLevel, useful
from runtime.plan.savings import Saving
from runtime.records import F64
from runtime.support.background import Job

log = logging.getLogger("phasestack.budget")

T = TypeVar("T")

FRAMES_KEPT = 30
FEWEST_FRAMES = 5
CLOSING_S = 0.5  # for what is being measured to let go of its level
VIEWER_M = ((0.6, -0.031, 0.0), (0.6, 0.031, 0.0))  # before anybody was seen


class Solving(Protocol):
    """What the budget changes: the model that is used, and what is told of it."""

    @property
    def settings(self) -> Settings:
        """Those in force."""

    @property
    def content(self) -> ContentSource:
        """What is drawn at present."""

    def surround_level(self, predictor: Predictor) -> None:
        """Have the run's backend surround a model that may be used."""

    def use(self, predictor: Predictor) -> Predictor:
        """Another model, surrounded already, from the next solution on. Answers the one before it, which is the
        caller's to close."""

    def tell_level(self, label: str, saving: Saving) -> None:
        """What the plan says of the level that is shown; empty: no budget."""


class BudgetControl:
    """Holds `model.budget_ms` for one solver; without a budget it does nothing. The solver's thread uses it.

    Levels are measured with the run's backend, on the content and eyes of the moment: before the first solution where
    the settings have a budget, else on a thread of its own, which asks the solver's for one drawing a step, or for one
    solution where the backend needs the GL context. A level is switched to only when its predictor is warm; the
    neighbours of the present one are kept so.
    """

    def __init__(self, solving: Solving, stack: PanelStack, *, simulated: bool = False) -> None:
        """simulated: the clock is; levels cost what the configuration says, and the choice is the same every time."""
        self._solving, self._stack, self.simulated = solving, stack, simulated
        self._settings = solving.settings
        self._configured: Rung = (self._settings.model.name, 1.0)
        self._shown = self._configured
        self._levels: list[QualityLevel] = []
        self._keeper: BudgetKeeper | None = None
        self._calls = SolverCalls()
        self._unwanted: queue.SimpleQueue[Predictor] = queue.SimpleQueue()  # to be closed on the solver's thread
        self._measuring: Job[list[QualityLevel]] | None = None
        self._doing = ""  # what is being measured
        self._kept: dict[Rung, Predictor] = {}
        self._job: tuple[Rung, Job[Predictor]] | None = None  # makes one level ready
        self._failed: set[Rung] = set()
        self._frames_ms: deque[float] = deque(maxlen=FRAMES_KEPT)  # at the present level
        self._eyes_m: F64 = np.array(VIEWER_M)
        self._time_ns = 0
        self._problem = ""
        self._told_missed = False

    @property
    def budget_ms(self) -> float:
        """0: none."""
        return self._settings.model.budget_ms

    @property
    def stage_ms(self) -> dict[str, float]:
        """What each stage costs on a simulated clock at the present level."""
        if self._shown == self._configured:
            return self._settings.loop.simulated_stage_ms
        return simulated_stage_ms(self._shown, self._settings)

    def start(self, tell: Callable[[str], bool] = lambda _: True) -> None:
        """Measure and choose before the first frame. tell: told what is measured; False: stop that."""
        if self.budget_ms <= 0:
            return
        go_on = True

        def told(text: str) -> None:
            nonlocal go_on
            self._close_unwanted()  # one level at a time is enough to have in memory
            go_on = go_on and tell(f"measuring {text}")

        def ask(call: Callable[[], T]) -> T:
            if not go_on:
                raise NoLongerAsked("stopped")
            return call()

        scenery, host = self._scenery(), self._host(ask)
        try:
            self._choose(measured_levels(self._settings, scenery, host, simulated=self.simulated, tell=told))
            if self._wanted() != self._shown:
                self._switch(self._wanted(), ready_level(self._wanted(), self._settings, scenery, host))
        except PhasestackError as error:
            self._problem = str(error)
            log.error("budget: it can't be held: %s", error)
        finally:
            self._close_unwanted()

    def changed(self, *, content: bool = False, model: bool = False) -> None:
        """Other settings hold. content: another scene is shown; model: another one is configured and in use."""
        settings = self._solving.settings
        budget_too = settings.model.budget_ms != self.budget_ms
        self._settings = settings
        if content or model:
            self._stop_asking()
        if model:
            self._forget_levels()
            self._configured = self._shown = (settings.model.name, 1.0)
            self._levels, self._keeper = [], None
        if self.budget_ms <= 0:
            self._stop_asking()
            self._levels, self._keeper, self._problem = [], None, ""
            self._forget_levels(but=(self._configured,))
            self._report()
        elif content or model or not self._levels:
            self._measure()
        elif budget_too:
            self._choose(self._levels)

    def step(self, *, eyes_m: F64 | None, time_ns: int, took_ms: float | None) -> None:
        """One step of the solver is complete: learn from it, and take over what has become ready.

        eyes_m: (2, 3) of the newest request, frame `stack`; took_ms: of the solution, where one was made.
        """
        self._close_unwanted()
        if self.budget_ms <= 0 and self._shown == self._configured:
            return
        self._time_ns = time_ns
        if eyes_m is not None:
            self._eyes_m = eyes_m
        self._calls.serve()
        self._take_measurement()
        if took_ms is not None and self._wanted() == self._shown:
            self._frame_took(took_ms)
        self._approach(self._wanted())

    def describe(self) -> dict[str, Any] | None:
        """For the status; None without a budget."""
        if self.budget_ms <= 0:
            return None
        keeper, saving = self._keeper, self._saving()
        return {
            "budget_ms": self.budget_ms,
            "level": self._label(),
            "held": None if keeper is None else keeper.held,
            "saves_ms": saving.saves_ms,
            "costs_db": saving.costs_db,
            "switches": 0 if keeper is None else keeper.switches,
            "measuring": self._doing,
            "problem": self._problem,
            "levels": [asdict(level) for level in self._levels],
        }

    def close(self) -> None:
        """Let go of every level but the pipeline's own. May be called twice."""
        jobs = [self._measuring, self._job and self._job[1]]
        self._stop_asking()
        for job in jobs:
            if job is not None:
                job.wait(CLOSING_S)
        self._forget_levels()
        self._close_unwanted()

    def _wanted(self) -> Rung:
        if self.budget_ms <= 0:
            return self._configured
        return self._shown if self._keeper is None else _rung(self._keeper.level)

    def _frame_took(self, time_ms: float) -> None:
        if self._measuring is None:
            self._frames_ms.append(time_ms)
        keeper = self._keeper
        if keeper is None or self._measuring is not None:
            return
        before = keeper.level
        if keeper.frame_took(time_ms):
            log.info("budget: %s instead of %s (%s)", keeper.level.label, before.label, _why(before, keeper))
            self._told_missed = False
        elif keeper.held is False and keeper.lightest and not self._told_missed:
            self._told_missed = True
            log.warning("budget: %g ms can't be held: the lightest level takes %.1f ms", self.budget_ms, time_ms)

    def _approach(self, wanted: Rung) -> None:
        """Switch where the wanted level is ready; else make it ready, then its neighbours, one at a time."""
        self._take_predictor()
        if wanted != self._shown and wanted in self._kept:
            self._switch(wanted, self._kept.pop(wanted))
        near = self._neighbours()
        self._forget_levels(but=(wanted, *near))
        have = {self._shown, *self._kept, *self._failed}
        missing = [rung for rung in (wanted, *near) if rung not in have]
        if missing and self._job is None and self._measuring is None:
            self._get_ready(missing[0])

    def _get_ready(self, rung: Rung) -> None:
        name = f"model {QualityLevel(*rung, 0.0, 0.0).label}"
        work = partial(ready_level, rung, self._settings, self._scenery(), self._host(self._calls))
        self._job = rung, Job(name, work, discard=self._unwanted.put)

    def _take_predictor(self) -> None:
        if self._job is None or not self._job[1].done:
            return
        (rung, job), self._job = self._job, None
        predictor = job.take()
        if predictor is not None:
            self._kept[rung] = predictor
        else:  # not tried again until something changes
            self._failed.add(rung)
            self._problem = job.problem
            log.error("budget: %s", job.problem)

    def _neighbours(self) -> list[Rung]:
        """The levels that may be wanted next, the lighter one first: it is wanted in a hurry."""
        if self._keeper is None or self.simulated:
            return []
        near = (self._keeper.index + 1, self._keeper.index - 1)
        return [_rung(self._keeper.levels[index]) for index in near if 0 <= index < len(self._keeper.levels)]

    def _switch(self, rung: Rung, predictor: Predictor) -> None:
        previous = self._solving.use(predictor)
        if self._shown in self._neighbours():
            self._kept[self._shown] = previous
        else:
            previous.close()
        self._shown = rung
        self._frames_ms.clear()
        self._report()

    def _measure(self) -> None:
        """Begin to measure, alongside the loop; the present level stays until that is done."""
        settings, scenery, host = self._settings, self._scenery(), self._host(self._calls)
        self._problem = ""

        def tell(text: str) -> None:
            self._doing = text

        self._measuring = Job("budget", lambda: measured_levels(settings, scenery, host, tell=tell))

    def _take_measurement(self) -> None:
        if self._measuring is None or not self._measuring.done:
            return
        job, self._measuring, self._doing = self._measuring, None, ""
        levels = job.take()
        if levels is None:
            self._problem = job.problem
            log.error("budget: the levels could not be measured: %s", job.problem)
            return
        self._choose(self._as_the_loop_finds_them(levels))

    def _as_the_loop_finds_them(self, levels: list[QualityLevel]) -> list[QualityLevel]:
        """Times that were measured alongside the loop, scaled by what its own frames took before that."""
        present = [level for level in levels if _rung(level) == self._shown]
        if not present or len(self._frames_ms) < FEWEST_FRAMES:
            return levels
        ratio = float(np.median(self._frames_ms)) / present[0].expected_ms
        return [replace(level, expected_ms=level.expected_ms * ratio) for level in levels]

    def _choose(self, levels: list[QualityLevel]) -> None:
        self._levels = levels
        self._keeper = BudgetKeeper(useful(levels), self.budget_ms)
        self._told_missed = False
        log.info("budget: %g ms: %s", self.budget_ms, self._keeper.level.label)
        self._report()

    def _saving(self) -> Saving:
        """The level that is shown against the configured model, as they were measured together."""
        measured = {_rung(level): level for level in self._levels}
        if self._configured not in measured or self._shown not in measured:
            return Saving()
        whole, shown = measured[self._configured], measured[self._shown]
        return Saving(whole.expected_ms - shown.expected_ms, whole.psnr_db - shown.psnr_db)

    def _report(self) -> None:
        """Tell the plan."""
        label = self._label() if self.budget_ms > 0 and self._keeper is not None else ""
        self._solving.tell_level(label, self._saving())

    def _label(self) -> str:
        return QualityLevel(*self._shown, 0.0, 0.0).label

    def _scenery(self) -> Scenery:
        fov_deg = self._settings.content.fov_deg
        return Scenery(self._solving.content, self._eyes_m, self._time_ns, self._stack, fov_deg)

    def _host(self, ask: Ask) -> LevelHost:
        return LevelHost(ask, self._solving.surround_level, self._unwanted.put)

    def _close_unwanted(self) -> None:
        while not self._unwanted.empty():
            self._unwanted.get().close()

    def _stop_asking(self) -> None:
        """What is being measured or made ready is for a picture that is no more."""
        self._calls.close()
        self._calls = SolverCalls()
        if self._job is not None:
            self._job[1].abandon()
        if self._measuring is not None:
            self._measuring.abandon()
        self._job, self._measuring, self._doing, self._failed = None, None, "", set()

    def _forget_levels(self, *, but: Collection[Rung] = ()) -> None:
        for rung in [rung for rung in self._kept if rung not in but]:
            self._kept.pop(rung).close()


def _rung(level: QualityLevel) -> Rung:
    return level.model, level.scale


def _why(before: QualityLevel, keeper: BudgetKeeper) -> str:
    """One phrase for the log."""
    if keeper.level.psnr_db < before.psnr_db:
        return f"frames took longer than {keeper.budget_ms:g} ms"
    return f"there has been room in {keeper.budget_ms:g} ms"
