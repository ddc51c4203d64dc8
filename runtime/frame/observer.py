"""Observes refreshes outside their own time: lines of frames.jsonl, sampled quality, kept light.

Lines wait until the recording has said where the eyes really were; so do measurements. In simulated time they are
made at once; in real time the solver's thread draws what is compared and a thread of its own compares, and while one
measurement is under way no other begins.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any, Protocol

import numpy as np

from runtime.clock import NS_PER_S
from runtime.content.base import ContentSource
from runtime.errors import ContentFailure
from runtime.evaluation.contact_sheet import Moment
from runtime.evaluation.displayed import displayed
from runtime.frame.presenter import Refresh
from runtime.frame.solver_host import SolverHost
from runtime.optics.alignment import shown_layers
from runtime.optics.carried import carried_db, light_psnrs_db
from runtime.optics.light import Sampling
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import retina_pictures
from runtime.records import F64, U8, RefreshAccount, SensorFrame, State
from runtime.support.background import Job

log = logging.getLogger("phasestack.quality")

MEASURED = Sampling(step=2)  # light, of a part of the pixels
FIGURES = ("light_db", "psnr_db", "ssim", "carried_db", "psnr_db_true_eyes", "carried_db_true_eyes")
WAITING_MAX = 2048  # lines that wait for the truth; older ones go without
DRAWN_WITHIN_S = 10.0  # the pictures of the last refresh, by the solver


LINE = (
    "frame", "capture_ns", "predicted_for_ns", "present_ns", "eyes_m", "eyes_label", "eye_sigma_mm", "state",
    "solution", "solved_for_m", "solution_age_ms", "true_eyes_m", "inference", "presented", "stage_ms", "skew_ms",
)  # fmt: skip
Pictures = dict[str, tuple[U8, U8]]  # of both eyes: `solved`, `used`, `true`


GAP_NS = NS_PER_S // 5  # a longer gap says nothing of what happened in it
KEPT = 512  # true positions: eight seconds at 60 Hz


class TrueEyes:
    """The recorded truth at samples' captures, interpolated between them."""

    def __init__(self) -> None:
        self._known: deque[tuple[int, F64]] = deque(maxlen=KEPT)
        self._ended = False

    def add(self, capture_ns: int, eyes_m: F64) -> None:
        """A sample's truth, (2, 3), frame `stack`."""
        if not self._known or capture_ns > self._known[-1][0]:
            self._known.append((capture_ns, eyes_m))

    def end(self) -> None:
        """No more samples will come."""
        self._ended = True

    def may_come(self, time_ns: int) -> bool:
        """Whether the truth of an instant is still unknown but may come with later samples."""
        return bool(self._known) and time_ns > self._known[-1][0] and not self._ended

    def at(self, time_ns: int) -> F64 | None:
        """(2, 3) at an instant; None: it is not known."""
        if not self._known or time_ns > self._known[-1][0]:
            return None
        after_ns, after_m = self._known[-1]
        for before_ns, before_m in reversed(self._known):
            if before_ns <= time_ns:
                if before_ns == time_ns:
                    return before_m
                if after_ns - before_ns > GAP_NS:
                    return None
                weight = (time_ns - before_ns) / (after_ns - before_ns)
                eyes: F64 = (1 - weight) * before_m + weight * after_m
                return eyes
            after_ns, after_m = before_ns, before_m
        return None


class Output(Protocol):
    """Where a run's files go."""

    def refresh(self, line: dict[str, Any]) -> None:
        """One line of frames.jsonl."""

    def light(self, frame: int, *, layers: U8, drawn: tuple[U8, U8] | None, info: dict[str, Any]) -> None:
        """What the panels showed at one refresh."""


Measured = tuple[Moment, dict[str, float]]  # at the eyes aligned to; of FIGURES, those that could be measured


class RunObserver:
    """Takes in samples and refreshes; `finish` ends it."""

    def __init__(
        self,
        stack: PanelStack,
        solver: SolverHost,
        *,
        fov_deg: float,
        measure: bool = False,
        evaluate_every: int = 0,
        keep_light: int = 0,
        output: Output | None = None,
        on_account: Callable[[RefreshAccount], None] | None = None,
        simulated: bool = False,
    ) -> None:
        """measure: quality is sampled, every `evaluate_every` refreshes and at the end; keep_light: 0, none."""
        self._stack, self._solver, self._fov_deg = stack, solver, fov_deg
        self._measure, self._every, self._keep_light = measure, evaluate_every, keep_light
        self._output, self._on_account, self._simulated = output, on_account, simulated
        self.truth = TrueEyes()
        self.measured: dict[str, list[float]] = {}  # of FIGURES, at the sampled refreshes
        self.moment: Moment | None = None  # the newest refresh measured: stills, sheet and viewer are of this one
        self.last: Refresh | None = None
        self._lines: deque[RefreshAccount] = deque()
        self._samples: deque[Refresh] = deque()
        self._job: Job[Measured | None] | None = None
        self._drawing = False

    def sampled(self, sample: SensorFrame) -> None:
        if sample.true_eyes_m is not None:
            self.truth.add(sample.capture_ns, sample.true_eyes_m)

    def refreshed(self, refresh: Refresh) -> None:
        self.last = refresh
        if self._on_account is not None:
            self._on_account(refresh.account)
        if self._output is not None:
            self._lines.append(refresh.account)
        if self._is_sample(refresh.account) and (self._simulated or not self._busy):
            self._samples.append(refresh)
        self._advance()

    def finish(self, *, patient: bool = True) -> None:
        """No more refreshes: what waits is written and measured, and the last refresh is looked at.

        In real time it is not where another was, nor where somebody waits for the run to stop (not patient).
        """
        self.truth.end()
        self._advance()
        last = self.last
        if not self._simulated and (self.moment is not None or not patient):
            return
        if last is None or not self._measure or not _has_picture(last) or last.account.eyes_m is None:
            return
        true_m = self.truth.at(last.account.photon_ns)
        found: SimpleQueue[Pictures] = SimpleQueue()
        self._draw(last, true_m, found.put)
        try:
            pictures = found.get(timeout=0.0 if self._simulated else DRAWN_WITHIN_S)
        except Empty:
            return
        measured = self._compared(last, true_m, pictures)
        if measured is not None:
            self._take(measured, counts=not self.measured and last.account.state is State.TRACKING)

    @property
    def _busy(self) -> bool:
        return bool(self._samples) or self._drawing or self._job is not None

    def _is_sample(self, account: RefreshAccount) -> bool:
        every, light = self._every, self._keep_light
        sampled = self._measure and every and account.frame % every == every - 1
        return bool(sampled or (light and account.frame % light == light - 1))

    def _advance(self) -> None:
        while self._lines:
            photon_ns = self._lines[0].photon_ns
            if self.truth.may_come(photon_ns) and len(self._lines) < WAITING_MAX:
                break
            assert self._output is not None
            self._output.refresh(line_of(replace(self._lines.popleft(), true_eyes_m=self.truth.at(photon_ns))))
        if self._job is not None and self._job.done:
            job, self._job = self._job, None
            self._take(job.take())
        while self._samples and self._job is None and not self._drawing:
            photon_ns = self._samples[0].account.photon_ns
            if self.truth.may_come(photon_ns):
                break
            self._begin(self._samples.popleft(), self.truth.at(photon_ns))

    def _begin(self, refresh: Refresh, true_m: F64 | None) -> None:
        """Draw what is compared, on the solver's thread, then compare."""

        def compare(drawn: Pictures) -> None:
            if self._simulated:
                self._take(self._compared(refresh, true_m, drawn))
            else:
                self._job = Job("quality", lambda: self._compared(refresh, true_m, drawn))

        self._draw(refresh, true_m, compare)

    def _draw(self, refresh: Refresh, true_m: F64 | None, then: Callable[[Pictures], None]) -> None:
        """Retina pictures, drawn between two steps of the solver."""

        def task(parts: Any) -> bool:
            try:
                with suppress(ContentFailure):  # the state says so
                    then(self._drawn(parts.content, refresh, true_m))
            finally:
                self._drawing = False
            return True

        self._drawing = True
        self._solver.do(task)

    def _drawn(self, content: ContentSource, refresh: Refresh, true_m: F64 | None) -> Pictures:
        """Retina pictures: of the eyes solved for, of those aligned to, of the true ones."""
        solution, account = refresh.solution, refresh.account
        if solution is None or solution.solved_for_m is None:
            return {}
        wanted: dict[str, F64 | None] = {"solved": solution.solved_for_m}
        if self._is_measured(refresh):
            wanted["used"] = account.eyes_m
            if true_m is not None:
                wanted["true"] = true_m
        time_ns = solution.solved_for_ns
        return {
            name: retina_pictures(content, eyes_m, self._stack, fov_deg=self._fov_deg, time_ns=time_ns)
            for name, eyes_m in wanted.items()
            if eyes_m is not None
        }

    def _is_measured(self, refresh: Refresh) -> bool:
        account, every = refresh.account, self._every
        return (
            self._measure
            and account.state is State.TRACKING
            and _has_picture(refresh)
            and account.eyes_m is not None
            and (every == 0 or account.frame % every == every - 1 or refresh is self.last)
        )

    def _compared(self, refresh: Refresh, true_m: F64 | None, drawn: Pictures) -> Measured | None:
        account = refresh.account
        try:
            layers = shown_layers(refresh.frame)
        except ValueError:
            return None
        if self._keep_light and account.frame % self._keep_light == self._keep_light - 1 and self._output is not None:
            info = {
                "solved_for_m": account.solved_for_m,
                "eyes_m": account.eyes_m,
                "true_eyes_m": true_m,
                "fov": self._fov_deg,
            }
            self._output.light(account.frame, layers=layers, drawn=drawn.get("solved"), info=info)
        if "used" not in drawn or account.eyes_m is None or account.solved_for_m is None or refresh.solution is None:
            return None
        stack, fov_deg, solved_for_m = self._stack, self._fov_deg, account.solved_for_m

        def seen_db(of: str, *, solved_for_m: F64, eyes_m: F64) -> float:
            """One ray a pixel, against the pictures of some eyes."""
            return carried_db(layers, drawn[of], stack, solved_for_m=solved_for_m, eyes_m=eyes_m, fov_deg=fov_deg)

        try:
            views = displayed(layers, drawn["used"], stack, eyes_m=account.eyes_m, fov_deg=fov_deg)
            light = light_psnrs_db(
                layers,
                drawn["solved"],
                stack,
                eyes_m=solved_for_m,
                seen_from_m=account.eyes_m,
                sigmas_mm=(TRACKING_SIGMA_MM,),
                fov_deg=fov_deg,
                sampling=MEASURED,
            )
            light_db, solution = light[TRACKING_SIGMA_MM], refresh.solution.layers
            moment = Moment(layers, views, light_db, _where(account), solution, solved_for_m, drawn["solved"])
            values = [moment.light_db, views.quality.psnr_db, views.quality.ssim]
            values.append(seen_db("solved", solved_for_m=solved_for_m, eyes_m=account.eyes_m))
            if true_m is not None:
                values.append(seen_db("true", solved_for_m=true_m, eyes_m=true_m))
                values.append(seen_db("solved", solved_for_m=solved_for_m, eyes_m=true_m))
            return moment, dict(zip(FIGURES, values, strict=False))
        except ValueError as error:
            log.info("quality: not measured here (%s)", error)
            return None

    def _take(self, measured: Measured | None, *, counts: bool = True) -> None:
        if measured is not None:
            self.moment, figures = measured
            for name, value in figures.items() if counts else ():
                self.measured.setdefault(name, []).append(value)

    def summary(self) -> dict[str, Any]:
        """The measured part of summary.json: means; None where nothing was measured."""
        found = self.measured
        means = {name: round(float(np.mean(found[name])), 3) if name in found else None for name in FIGURES}
        return {**means, "quality_frames": len(found.get("psnr_db", []))}


def _where(account: RefreshAccount) -> tuple[str, ...]:
    """Where the eyes are in a moment, what they do, and how well that is known."""
    assert account.eyes_m is not None and account.solved_for_m is not None
    sure = "" if account.eye_sigma_mm is None else f", sure to {account.eye_sigma_mm:.1f} mm"
    moved_mm = 1000 * float(np.linalg.norm((account.eyes_m - account.solved_for_m).mean(axis=0)))
    line = f"Refresh {account.frame}; eyes {account.eyes_label}{sure}"
    return (f"{line}, {moved_mm:.0f} mm from where the layers were solved for: the outer panels were shifted along",)


def _has_picture(refresh: Refresh) -> bool:
    """Whether the panels show a solution for two eyes, and nothing of the flat picture."""
    solution = refresh.solution
    return (
        refresh.account.presented
        and refresh.frame.flatness == 0.0
        and solution is not None
        and solution.solved_for_m is not None
        and solution.seeing == (True, True)
    )


def line_of(account: RefreshAccount) -> dict[str, Any]:
    """A line of frames.jsonl (contract 5.2)."""
    return {name: _plain(getattr(account, name)) for name in LINE}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    return str(value) if isinstance(value, State) else value
