"""Measure the quality of a sample of refreshes, each once its true eyes are known.

The solver draws the target pictures. In real time, another process compares them with one refresh's layers at a time
(`measuring`), starting with the newest refresh. It works during only a small share of the run, because measuring must
not slow down the solutions being measured. If refreshes come due while a measurement is running, a few of them are
queued and measured after the run, and the others are dropped. On a simulated clock, every refresh that is due is
measured, in order. For a page that shows the display live, the newest refresh is measured whenever its figure is out of
date.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from runtime.evaluation.contact_sheet import Moment
from runtime.evaluation.refresh_quality import (
    FIGURES,
    RefreshQuality,
    RefreshTargets,
    solved_eyes_of,
    true_eyes_of,
)
from runtime.frame.measuring import Comparison, MeasuringProcess, compared
from runtime.frame.messages import Wanted
from runtime.frame.refresh import Refresh
from runtime.frame.targets import TargetDrawer
from runtime.frame.truth import TrueEyes
from runtime.optics.carried import intensities
from runtime.optics.focus import retina_db
from runtime.optics.presentation import shown_layers
from runtime.optics.quality import psnr_db
from runtime.optics.stack import PanelStack
from runtime.records import F64, RefreshAccount, State
from runtime.support.background import BackgroundJob

HELD_MAX = 5  # maximum number of refreshes queued in real time
HELD_BYTES = 200 << 20  # limit for the queued refreshes' layers; a refresh takes 25 MB at 1080p on the full raster
MEASURING_SHARE = 0.1  # largest share of a real-time run spent on measuring
LIVE_SHARE = 0.3  # the same for a live page, whose measurements take a third of the time
MEASURED_WITHIN_S = 60.0  # timeout for measuring the queued refreshes after the run
LOOK_S = 0.02  # interval for checking whether the queue is done
DRAWN_WITHIN_S = 30.0  # timeout for drawing the last refresh's target pictures
MOVED_M = 0.002  # a figure applies until an eye has moved this far, about twice a tracker's error
REST_S = 0.3  # how long the eyes must rest before a live page's refresh is measured again
SETTLED_S = 1.0  # once a solution has been shown for this long, figures of earlier ones no longer apply


@dataclass(frozen=True, slots=True)
class _Sample:
    refresh: Refresh
    scene: int  # the run's scene at this refresh


class QualitySampler:
    """Measures the quality of every `every`-th refresh and, if `finish` is called, of the last one. If
    `every` is 0, only the last refresh is measured. If `newest` is true, light is instead measured at the newest
    refresh whenever the eyes, the content or the model have changed since the last measurement.
    """

    def __init__(
        self,
        stack: PanelStack,
        drawer: TargetDrawer,
        truth: TrueEyes,
        measuring: MeasuringProcess,
        *,
        every: int,
        simulated: bool,
        newest: bool = False,
    ) -> None:
        self._stack, self._drawer, self._truth, self._measuring = stack, drawer, truth, measuring
        self._every, self._simulated, self._newest = every, simulated, newest
        self._rests_at: RefreshAccount | None = None  # has the eyes since `_rests_since_s`, to within `MOVED_M`
        self._rests_since_s = 0.0
        self._tried: Refresh | None = None  # latest refresh to be measured
        self._shown, self._shown_since_s = -1, 0.0  # number of the solution shown, and since when
        self.only_live = False  # if True, only live quality is measured
        self.measured: dict[str, list[float]] = {}  # values for each sampled refresh, keyed by name in FIGURES
        self.live: dict[int, float] = {}  # mean squared error of the light at the true eyes, by refresh number
        self._people: dict[int, list[float]] = {}  # the same errors, by number; 0: not served yet
        self.moment: Moment | None = None  # latest measured refresh, for the stills, contact sheet and viewer page
        self._waiting: deque[_Sample] = deque()
        self._job: BackgroundJob[RefreshQuality | None] | None = None
        self._job_frame = self._moment_frame = -1
        self._samples = 0
        self.retina_db: float | None = None  # of the last refresh's solution (docs/contracts.md, Error)
        self._drawing = False
        self._began_s = self._resumes_s = 0.0  # when the latest measurement began, and when the next may begin

    def refreshed(self, refresh: Refresh) -> None:
        """Queue a refresh if it is due; in real time, drop earlier ones from a queue that is too large."""
        if self._newest:
            self._replace_waiting(refresh)
            return
        is_sample = self._every and refresh.account.frame % self._every == self._every - 1
        if not is_sample or not refresh.account.presented:
            return
        self._samples += 1
        self._waiting.append(_Sample(refresh, self._drawer.scene))
        while not self._simulated and len(self._waiting) > 1 and self._holds_too_much():
            del self._waiting[self._samples % (len(self._waiting) - 1)]

    def _replace_waiting(self, refresh: Refresh) -> None:
        """Make `refresh` the only one in the queue if its figure is out of date and the eyes rest, or else empty it."""
        self._waiting.clear()
        account, solution, now_s = refresh.account, refresh.solution, time.monotonic()
        if not is_measurable(refresh) or account.eyes_m is None or solution is None:
            return
        if self._rests_at is None or not _rest(self._rests_at, account):
            self._rests_at, self._rests_since_s = account, now_s
        if self._shown != solution.number:
            self._shown, self._shown_since_s = solution.number, now_s
        measured = None if self.moment is None or not applies_to(self.moment, refresh) else self.moment.account
        if measured is not None and measured.solution == solution.number:
            return
        tried = self._tried
        if tried is None or not _is_alike(tried, refresh) or self._has_settled(tried.account.solution):
            self._resumes_s = 0.0
        if now_s - self._rests_since_s >= REST_S:
            self._waiting.append(_Sample(refresh, self._drawer.scene))

    def _has_settled(self, before: int | None) -> bool:
        """Return True if a solution other than `before` has been shown for some time, such as a refined one at rest."""
        return before != self._shown and time.monotonic() - self._shown_since_s >= SETTLED_S

    def figure_of(self, refresh: Refresh) -> Moment | None:
        """Return the latest measurement if it holds for a refresh of a live page, or None."""
        moment = self.moment
        if moment is None or moment.account is None or not applies_to(moment, refresh):
            return None
        return None if self._has_settled(moment.account.solution) else moment

    def _holds_too_much(self) -> bool:
        layers = [sample.refresh.solution.layers for sample in self._waiting if sample.refresh.solution is not None]
        return len(self._waiting) > HELD_MAX or sum(each.nbytes for each in layers) > HELD_BYTES

    @property
    def _is_busy(self) -> bool:
        return bool(self._waiting) or self._drawing or self._job is not None

    def drain(self, stopped: Callable[[], bool]) -> None:
        """Measure the queued refreshes after the run, until `stopped`."""
        ends_s = time.monotonic() + MEASURED_WITHIN_S
        self._collect()
        while self._is_busy and not stopped() and time.monotonic() < ends_s:
            self._drawer.look()
            self.advance(at_once=True)
            if self._is_busy:
                time.sleep(LOOK_S)

    def advance(self, *, at_once: bool = False) -> None:
        """Collect a finished measurement, and measure queued refreshes whose true eyes are known. `at_once`:
        even if measuring takes more than `MEASURING_SHARE` of the run.
        """
        self._collect()
        now_s = time.monotonic()
        if not (self._simulated or at_once) and now_s < self._resumes_s:
            return
        while self._waiting and self._job is None and not self._drawing:
            first = 0 if self._simulated else -1
            if not self._newest and self._truth.may_come(self._waiting[first].refresh.account.photon_ns):
                return
            sample = self._waiting[first]
            del self._waiting[first]
            self._began_s = now_s
            self._tried = sample.refresh
            self._begin(sample)

    def _collect(self) -> None:
        if self._job is not None and self._job.done:
            job, self._job = self._job, None
            self._take(self._job_frame, job.take())
            now_s = time.monotonic()
            share = LIVE_SHARE if self._newest else MEASURING_SHARE
            self._resumes_s = now_s + (now_s - self._began_s) * (1 / share - 1)

    def finish(self, last: Refresh) -> None:
        """Measure the last refresh, which counts towards the means only if no other one was measured."""
        account = self._truth.of(last.account)
        targets = self._drawn(self._wanted(last, account))
        quality = None if targets is None else compared(self._comparison(last, account, targets), self._stack)
        counts = not self.measured and last.account.state is State.TRACKING
        self._take(last.account.frame, quality, figures=counts, live=not self.live)

    def measure_retina(self, last: Refresh) -> None:
        """Measure the retina pictures of the last refresh's solution, if its content might get focus."""
        solution = last.solution
        if solution is None or solution.solved_for_m is None or not (is_measurable(last) and self._drawer.may_focus):
            return
        targets = self._drawn({"focused": (solution.solved_for_m, solution.solved_for_ns)})
        if targets is None or targets.focused is None:
            return
        focused, unaligned = targets.focused, replace(last.frame, parallax=None, solved_from_shown=())
        seen = focused.seen(shown_layers(unaligned), self._stack)
        self.retina_db = retina_db(zip(seen, map(intensities, focused.pictures), strict=True))
        if self.moment is not None and solution.effort is not None and solution.effort.focus:
            self.moment = replace(self.moment, focused=(focused, tuple(retina.codes() for retina in seen)))

    def _drawn(self, wanted: Wanted) -> RefreshTargets | None:
        """Have target pictures drawn after the run, and wait for them. None if they cannot be drawn in time."""
        drawn: list[RefreshTargets | None] = []
        self._drawer.draw(wanted, None, drawn.append)
        ends_s = time.monotonic() + DRAWN_WITHIN_S
        while not drawn and not self._simulated and time.monotonic() < ends_s:
            time.sleep(LOOK_S)
            self._drawer.look()
        return drawn[0] if drawn else None

    def _begin(self, sample: _Sample) -> None:
        refresh, frame = sample.refresh, sample.refresh.account.frame
        account = refresh.account if self._newest else self._truth.of(refresh.account)
        wanted = self._wanted(refresh, account)
        if not wanted:
            return

        def compare(targets: RefreshTargets | None) -> None:
            self._drawing = False
            if targets is None:
                return
            comparison = self._comparison(refresh, account, targets)
            if self._simulated:
                self._take(frame, compared(comparison, self._stack))
            else:
                self._job_frame = frame
                self._job = BackgroundJob("quality", lambda: self._measuring.compared(comparison))

        self._drawing = True
        self._drawer.draw(wanted, sample.scene, compare)

    def _wanted(self, refresh: Refresh, account: RefreshAccount) -> dict[str, tuple[F64, int]]:
        """Return the eyes (2, 3) and the time to draw each target for, keyed by field of `RefreshTargets`."""
        solution, true, eyes = refresh.solution, [*true_eyes_of(account).values()], solved_eyes_of(account)
        wanted: dict[str, tuple[F64, int]] = {}
        if true:
            wanted["true"] = np.concatenate(true), account.photon_ns
        if self.only_live:
            return wanted
        if solution is not None and eyes is not None and is_measurable(refresh):
            wanted["solved"] = eyes[0], solution.solved_for_ns
            wanted["used"] = eyes[1], solution.solved_for_ns
        return wanted

    def _comparison(self, refresh: Refresh, account: RefreshAccount, targets: RefreshTargets) -> Comparison:
        return Comparison(account, refresh.frame, targets, for_page=self._newest, state_version=refresh.state_version)

    def _take(self, frame: int, quality: RefreshQuality | None, *, figures: bool = True, live: bool = True) -> None:
        if quality is None:
            return
        if quality.moment is not None and frame > self._moment_frame:
            self.moment, self._moment_frame = quality.moment, frame
        for name, value in quality.figures.items() if figures else ():
            self.measured.setdefault(name, []).append(value)
        if live and quality.live_error is not None:
            self.live[frame] = quality.live_error
            for number, error in quality.people_errors.items():
                self._people.setdefault(number, []).append(error)

    @property
    def live_db(self) -> float | None:
        """Live quality of the refreshes measured so far, in dB (docs/contracts.md, Error)."""
        return round(psnr_db(float(np.mean(list(self.live.values())))), 3) if self.live else None

    @property
    def live_db_of_people(self) -> dict[int, float]:
        """Live quality of each person who was served, in dB, by number."""
        people = {number: errors for number, errors in self._people.items() if number}
        if len(people) == 1 and 0 in self._people:
            (number,) = people
            people[number] = self._people[0] + people[number]
        return {number: round(psnr_db(float(np.mean(errors))), 3) for number, errors in people.items()}

    def summary(self) -> dict[str, Any]:
        """Return the quality figures for summary.json. Any figure that was not measured is null."""
        means = {
            name: round(float(np.mean(self.measured[name])), 3) if name in self.measured else None for name in FIGURES
        }
        counts = {"quality_frames": len(self.measured.get("psnr_db", [])), "live_frames": len(self.live)}
        retina = self.retina_db
        return {"live_db": self.live_db, **means, "retina_db": None if retina is None else round(retina, 3), **counts}


def has_picture(refresh: Refresh) -> bool:
    """Return True if the panels show a solution for both eyes with none of the flat picture mixed in."""
    solution = refresh.solution
    return (
        refresh.account.presented
        and refresh.frame.flatness == 0.0
        and solution is not None
        and solution.solved_for_m is not None
        and all(solution.seeing)
    )


def is_measurable(refresh: Refresh) -> bool:
    """Return True if a viewer is tracked and the content is not stale, so that light can be measured."""
    solution = refresh.solution
    return (
        refresh.account.state is State.TRACKING
        and refresh.account.eyes_m is not None
        and has_picture(refresh)
        and solution is not None
        and solution.state_version == refresh.state_version
    )


def applies_to(moment: Moment, refresh: Refresh) -> bool:
    """Return True if a measurement of the same content, model and eyes holds for a refresh."""
    account = moment.account
    is_current = is_measurable(refresh) and moment.state_version == refresh.state_version
    return account is not None and is_current and _rest(account, refresh.account)


def _is_alike(before: Refresh, now: Refresh) -> bool:
    return before.state_version == now.state_version and _rest(before.account, now.account)


def _rest(before: RefreshAccount, now: RefreshAccount) -> bool:
    """Return True if as many people are served at two refreshes, and their eyes are within `MOVED_M`."""
    then_m, now_m = (
        [person.eyes_m for person in account.people or (account,) if person.eyes_m is not None]
        for account in (before, now)
    )
    moved_m = (np.abs(one - other).max() for one, other in zip(then_m, now_m, strict=False))
    return 0 < len(then_m) == len(now_m) and all(away_m <= MOVED_M for away_m in moved_m)
