"""The daemon: receive, map, predict, render, infer, present, account; turn after turn, until told to stop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from time import perf_counter
from typing import Any, Protocol

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.config import Settings
from runtime.errors import EndOfRecording, PanelLost
from runtime.evaluation.probe import Look, QualityProbe
from runtime.eyes.calibration import Calibration
from runtime.eyes.calibration_drift import SeparationWatch
from runtime.eyes.rest import RestWatch
from runtime.eyes.tracker import Tracker
from runtime.frame.inputs import Input
from runtime.frame.pipeline import Pipeline
from runtime.frame.states import Conditions, Part, StateMachine
from runtime.frame.stats import RunStats
from runtime.frame.timing import StageTimes
from runtime.panels.base import PanelSink
from runtime.plan.budget import BudgetControl
from runtime.plan.savings import Saving
from runtime.records import (
    F64,
    U8,
    EyesEstimate,
    FrameAccount,
    PanelFrame,
    PresentReport,
    SensorFrame,
    State,
)

log = logging.getLogger("phasestack.loop")

EXPECTED_WEIGHT = 0.1  # of the newest turn in the running mean of turn lengths


class Supervisor(Protocol):
    """What the loop tells the outside, and asks it, once a turn."""

    def stop_reason(self) -> str:
        """Why to stop; empty: go on."""

    def obey(self, loop: Loop) -> None:
        """Carry out what an operator asked for since the last turn."""

    def turn(self, loop: Loop, account: FrameAccount) -> None:
        """One turn is complete."""


class Unsupervised:
    """Nobody watches: a demo, a test."""

    def stop_reason(self) -> str:
        return ""

    def obey(self, loop: Loop) -> None:
        return

    def turn(self, loop: Loop, account: FrameAccount) -> None:
        return


@dataclass(slots=True)
class Flatness:
    """How far the picture has gone over to the flat one, 0 to 1; moves at a constant rate."""

    value: float = 1.0
    since_ns: int = -1

    def toward(self, target: float, *, blend_s: float, now_ns: int) -> float:
        """One step towards 0 or 1."""
        elapsed_s = 0.0 if self.since_ns < 0 else (now_ns - self.since_ns) / NS_PER_S
        self.since_ns = now_ns
        step = elapsed_s / blend_s if blend_s > 0 else 1.0
        self.value = max(target, self.value - step) if target < self.value else min(target, self.value + step)
        return self.value


@dataclass(slots=True)
class QualityMeans:
    """Sums over the sampled frames."""

    psnr_db: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    psnr_db_true_eyes: list[float] = field(default_factory=list)


class Loop:
    """One run. Everything it needs is given; it owns none of it but what it counts."""

    def __init__(
        self,
        settings: Settings,
        *,
        clock: Clock,
        source: Input,
        calibration: Calibration,
        tracker: Tracker,
        pipeline: Pipeline,
        panels: PanelSink,
        supervisor: Supervisor | None = None,
        probe: QualityProbe | None = None,
        on_account: Callable[[FrameAccount], None] | None = None,
        in_stack_frame: bool = False,
        context: Any = None,
        budget: BudgetControl | None = None,
    ) -> None:
        """context: the GL context of this thread, for content that is loaded while it runs; budget: a started one."""
        self.context = context
        self.settings, self.clock, self.source = settings, clock, source
        self.calibration, self.tracker, self.pipeline, self.panels = calibration, tracker, pipeline, panels
        self.budget = budget or BudgetControl(settings, pipeline)
        self._supervisor = supervisor or Unsupervised()
        self._probe, self._on_account = probe, on_account
        self._in_stack_frame = in_stack_frame
        self.stats = RunStats()
        self.machine = StateMachine(now_ns=clock.now_ns())
        self.flat_wanted = False
        self.paused = False
        self.layers: Any = None
        self.look: Look | None = None
        self.last: FrameAccount | None = None
        self.missing: dict[str, str] = {}  # parts that don't work at present, and why
        self.present_missing = ""
        self._flatness = Flatness()
        self._turn_cost_ns = self._first_cost_ns()
        self._watch = SeparationWatch(
            known_ipd_m=settings.calibration.ipd_m, tolerance=settings.calibration.ipd_tolerance
        )
        self._rest = _rest_watch(settings)
        self._served_m: F64 | None = None  # the eyes that were last found to be servable
        self._presented = False
        self._quality = QualityMeans()
        self._truth: list[tuple[int, F64]] = []  # the two newest samples' true eyes, with their capture times
        self._pending: tuple[int, int, U8] | None = None  # light and draw time of layers to be measured there
        self._serial_checked = False
        self._started_s = perf_counter()

    def apply(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        self.settings = settings
        self._rest = _rest_watch(settings)

    def _first_cost_ns(self) -> int:
        stages = self.budget.stage_ms
        return round(sum(cost for stage, cost in stages.items() if stage != "wait") * NS_PER_MS)

    def run(self, *, frames: int | None = None) -> str:
        """Turns until the recording ends, `frames` are done, or the supervisor says so. Answers why it stopped."""
        reason = ""
        while not reason:
            try:
                self.turn()
            except EndOfRecording:
                reason = "the recording has ended"
            reason = reason or self._supervisor.stop_reason()
            if frames is not None and self.stats.frames >= frames:
                reason = reason or f"{frames} frames done"
        conditions = Conditions("none", {}, presented=True, stopping=reason)
        self.machine.update(conditions, now_ns=self.clock.now_ns())
        return reason

    def turn(self) -> FrameAccount:
        """One turn of the loop. Raises EndOfRecording, FatalError."""
        stages = StageTimes(self.clock, self.budget.stage_ms)
        self.source.wait(rate_hz=self.settings.loop.rate_hz)
        stages.lap("wait")
        self._supervisor.obey(self)
        frame = self.source.receive()
        start_ns = self.clock.now_ns()
        stages.lap("sensor")
        if frame is not None:
            self._track(frame)
        light_ns = start_ns + self._turn_cost_ns + round(self.settings.loop.scanout_ms * NS_PER_MS)
        eyes = self._servable(self._rested(self.tracker.at(light_ns)))
        stages.lap("track")
        inference, missing, report = self._show(eyes, stages)
        if self.source.fault():
            missing["sensor"] = self.source.fault()
        self.missing = missing
        state = self._judge(eyes, missing)
        account = FrameAccount(
            frame=self.stats.frames,
            capture_ns=eyes.capture_ns,
            predicted_for_ns=light_ns,
            present_ns=report.present_ns if report else self.clock.now_ns(),
            eyes_m=eyes.eyes_m,
            eyes_label=eyes.label,
            state=state,
            inference=inference,
            presented=report is not None,
            skew_ms=report.skew_ms if report else 0.0,
            stage_ms=stages.stage_ms,
            measured_ms=stages.measured_ms,
        )
        self._account(account, stages, start_ns=start_ns, report=report)
        return account

    def _track(self, frame: SensorFrame) -> None:
        """Map a sample into `stack` and hand it to the tracker."""
        points = frame.eyes
        if points is not None and not self._in_stack_frame:
            points = self.calibration.apply(points)
            if drift := self._watch.update(points):
                log.warning("%s", drift)
        self.tracker.update(points, capture_ns=frame.capture_ns)
        if self._rest is not None and points is not None:
            self._rest.update(points.eyes_m, capture_ns=frame.capture_ns)
        if frame.true_eyes_m is not None:
            self._truth = [*self._truth[-1:], (frame.capture_ns, frame.true_eyes_m)]
        if not self._serial_checked and self.source.serial:
            self._serial_checked = True
            if warning := self.calibration.serial_warning(self.source.serial):
                log.warning("%s", warning)

    def _servable(self, eyes: EyesEstimate) -> EyesEstimate:
        """Eyes that see every panel from the front; others are dropped, counted and logged."""
        if eyes.eyes_m is None or eyes.eyes_m is self._served_m:
            return eyes
        front_m = max(self.pipeline.stack.x_m)
        if np.isfinite(eyes.eyes_m).all() and bool((eyes.eyes_m[:, 0] > front_m + 0.01).all()):
            self._served_m = eyes.eyes_m
            return eyes
        self.fault("eyes")
        log.warning("eyes: at %s, not in front of the panels: dropped", np.round(eyes.eyes_m, 3).tolist())
        return EyesEstimate(eyes.time_ns, eyes.capture_ns, None, "none", eyes.age_ns)

    def _rested(self, eyes: EyesEstimate) -> EyesEstimate:
        """Where the head rests, as long as it does: the same eyes turn after turn cost nothing, and don't jitter."""
        place = self._rest.place if self._rest is not None else None
        if place is None or eyes.eyes_m is None or eyes.label == "held":
            return eyes
        return replace(eyes, eyes_m=place)

    def _show(self, eyes: EyesEstimate, stages: StageTimes) -> tuple[Any, dict[str, str], PresentReport | None]:
        """Draw the frame and put it on the panels."""
        now_ns = self.clock.now_ns()
        wanted = 1.0 if eyes.eyes_m is None or self.flat_wanted else 0.0
        if not self._presented:
            self._flatness.value = wanted
        if not self.paused or self.layers is None:
            flatness = self._flatness.toward(wanted, blend_s=self.settings.tracker.blend_s, now_ns=now_ns)
            resting = self._rest is not None and eyes.eyes_m is not None and eyes.eyes_m is self._rest.place
            drawn = self.pipeline.draw(eyes.eyes_m, flatness=flatness, time_ns=now_ns, stages=stages, resting=resting)
            self.layers, inference, missing = drawn.layers, drawn.inference, drawn.missing
            unchanged = drawn.unchanged
        else:
            inference, missing, unchanged = "reused", {}, True
        report: PresentReport | None = None
        number = self.stats.frames
        try:
            report = self.panels.present(PanelFrame(number, self.layers, number), unchanged=unchanged)
            self._presented = True
        except PanelLost as error:
            missing["panel"] = str(error)
            self.fault("panel")
        stages.lap("present")
        return inference, missing, report

    def _judge(self, eyes: EyesEstimate, missing: dict[str, str]) -> State:
        parts: dict[Part, str] = {part: why for part, why in missing.items()}  # type: ignore[misc]
        conditions = Conditions(eyes.label, parts, presented=self._presented, flat_wanted=self.flat_wanted)
        transition = self.machine.update(conditions, now_ns=self.clock.now_ns())
        if transition is not None:
            log.info("state: %s -> %s (%s)", transition.before, transition.after, transition.reason)
        return self.machine.state

    def _account(
        self, account: FrameAccount, stages: StageTimes, *, start_ns: int, report: PresentReport | None
    ) -> None:
        if report is not None and account.inference == "ran":
            # One turn of a machine that was suspended must not make the loop look past every eye for good.
            longest_ns = round(self.settings.tracker.horizon_max_s * NS_PER_S)
            cost_ns = min(report.present_ns - start_ns, longest_ns)
            self._turn_cost_ns += round(EXPECTED_WEIGHT * (cost_ns - self._turn_cost_ns))
        self.last = account
        if self._on_account is not None:
            self._on_account(account)
        self._supervisor.turn(self, account)
        self.budget.turn(account)
        turn_ms = stages.turn_ms()
        self.stats.add(account, turn_ms=turn_ms)
        self._measure_pending()
        every = self.settings.loop.evaluate_every
        if self._probe is not None and every and account.frame % every == every - 1:
            self.measure()

    def fault(self, part: str) -> None:
        """Count a fault that the run lives on with."""
        self.stats.fault(part)

    def measure(self) -> None:
        """What the eyes see of the newest frame; only while tracking, and where a probe was given."""
        account = self.last
        if self._probe is None or account is None or account.state is not State.TRACKING or account.eyes_m is None:
            return
        if self._flatness.value > 0.0:
            return
        time_ns = self.clock.now_ns()
        try:
            self.look = self._probe.look(self.layers, self.pipeline.content, account.eyes_m, time_ns=time_ns)
            self._quality.psnr_db.append(self.look.quality.psnr_db)
            self._quality.ssim.append(self.look.quality.ssim)
            if self._truth:
                self._pending = (account.predicted_for_ns, time_ns, self.layers.copy())
        except ValueError as error:
            log.info("quality: not measured here (%s)", error)

    def plan_items(self) -> list[dict[str, Any]]:
        """What is left out at present; a saving or a cost that this run did not measure is None."""
        known = replace(self.pipeline.measured, reuse=Saving(saves_ms=self.stats.reuse_saves_ms()))
        return [asdict(item) for item in self.pipeline.plan_items(known)]

    def _measure_pending(self) -> None:
        """Quality at the true eyes at the moment of the light, once the recording has told where they were."""
        if self._pending is None or self._probe is None or not self._truth:
            return
        light_ns, drawn_ns, layers = self._pending
        if self._truth[-1][0] < light_ns:
            return
        self._pending = None
        if len(self._truth) < 2 or self._truth[0][0] > light_ns:
            return
        (before_ns, before_m), (after_ns, after_m) = self._truth
        weight = (light_ns - before_ns) / (after_ns - before_ns)
        true_m = (1 - weight) * before_m + weight * after_m
        try:
            true = self._probe.look(layers, self.pipeline.content, true_m, time_ns=drawn_ns)
            self._quality.psnr_db_true_eyes.append(true.quality.psnr_db)
        except ValueError as error:
            log.info("quality at the true eyes: not measured here (%s)", error)

    def seconds(self) -> float:
        """Since the loop was put together, on the machine's clock."""
        return perf_counter() - self._started_s

    def summary(self) -> dict[str, Any]:
        """summary.json (design 5.2)."""
        seconds = self.seconds()
        predictor = self.pipeline.predictor
        return {
            **self.stats.summary(seconds=seconds, stale_inputs=self.source.stale_inputs),
            "psnr_db": _mean(self._quality.psnr_db),
            "ssim": _mean(self._quality.ssim),
            "psnr_db_true_eyes": _mean(self._quality.psnr_db_true_eyes),
            "quality_frames": len(self._quality.psnr_db),
            "model": predictor.name,
            "provider": predictor.provider,
            "plan": self.plan_items(),
            "states": self.machine.seconds(now_ns=self.clock.now_ns()),
        }


def _rest_watch(settings: Settings) -> RestWatch | None:
    """None where the plan may not present a frame again for eyes that are only nearly the same."""
    plan = settings.plan
    most_m = (plan.dead_band_mm or settings.model.tolerance_mm) / 1000
    return RestWatch(most_m=most_m) if plan.enabled and plan.reuse and most_m > 0 else None


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 3) if values else None
