"""Present the latest solution at every refresh, aligned to the eyes at the display time.

At each refresh, the presenter takes in the samples that have arrived, predicts the eyes at the display time, aligns the
latest solution to them, presents it and records the result. The loop only ever waits for a refresh's time slot and, on
outputs without vertical blanks, for the time when its frame is due. In the first of these waits, it takes in samples
and solutions as they arrive, so that little is left to do between waking and presenting.
The solver (`solver_host`) runs in parallel and delivers complete solutions.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from runtime.clock import NS_PER_MS, Clock
from runtime.config import Settings
from runtime.errors import EndOfRecording, PanelLost
from runtime.eyes.calibration import Calibration
from runtime.frame.aim import Aim
from runtime.frame.messages import SolverUpdate
from runtime.frame.pacing import Pacer
from runtime.frame.policy import Flatness, wants_flat
from runtime.frame.refresh import Refresh, RefreshTimes, Status
from runtime.frame.served import accounts_of, matched
from runtime.frame.solver_host import SolverHost
from runtime.frame.states import Conditions, Lateness, Part, StateMachine
from runtime.frame.stats import RunStats
from runtime.frame.viewer import Viewer
from runtime.optics.alignment import Alignment, align
from runtime.optics.stack import PanelStack
from runtime.panels.base import PanelSink
from runtime.records import (
    F64,
    SHOWN_STAGES,
    Effort,
    EyesEstimate,
    FrameTiming,
    PanelFrame,
    Parallax,
    PresentReport,
    RefreshAccount,
    SensorFrame,
    Solution,
    State,
)
from runtime.sensor.samples import Samples

log = logging.getLogger("phasestack.presenter")

UNDISTURBED_NS = NS_PER_MS  # nothing is taken in for this long before a refresh wakes, because it could delay it
TAKEN_IN_MOST = 8  # how often something is taken in while waiting for one refresh


class Supervisor:
    """Hooks that let the daemon control the presenter, called once per refresh, which must not block."""

    def stop_reason(self) -> str:
        """Return the reason to stop, or an empty string to continue."""
        return ""

    def carry_out_commands(self, presenter: Presenter) -> None:
        """Carry out all operator commands received since the last refresh."""

    def refreshed(self, status: Status) -> None:
        """Handle a completed refresh's status."""


class Observer(Protocol):
    """Receives samples and refreshes, during each refresh, so its methods must return quickly."""

    def sampled(self, sample: SensorFrame) -> None:
        """Handle a sample that has arrived."""

    def refreshed(self, refresh: Refresh) -> None:
        """Handle a completed refresh."""


class Presenter:
    """Runs a run's refresh loop. All parts passed to the constructor belong to the caller."""

    def __init__(
        self,
        settings: Settings,
        stack: PanelStack,
        *,
        clock: Clock,
        pacer: Pacer,
        samples: Samples,
        viewer: Viewer,
        solver: SolverHost,
        panels: PanelSink,
        stage_ms: dict[str, float],
        supervisor: Supervisor | None = None,
        observers: Sequence[Observer] = (),
        fixed: Effort | None = None,
    ) -> None:
        """Create a presenter, whose stages take `stage_ms` on a simulated clock. `fixed` is the effort if
        `model.effort` is `full`, by default all steps on the full raster.
        """
        self.settings, self.stack, self.clock = settings, stack, clock
        self.pacer, self.samples, self.viewer, self.solver, self.panels = pacer, samples, viewer, solver, panels
        self._stage_ms = stage_ms
        self._supervisor, self._observers = supervisor or Supervisor(), observers
        self._aim = Aim(viewer, solver, period_ns=pacer.period_ns, fixed=fixed)
        self.stats = RunStats()
        self.machine = StateMachine(now_ns=clock.now_ns())
        self._lateness = Lateness(pacer.period_ns)
        self.flat_asked = False
        self.paused = False
        self.missing: dict[str, str] = {}  # reason for each failed part
        self.status: Status | None = None  # published once per refresh, for any thread
        self._flatness = Flatness()
        self._presented = False
        self._shown_solution: int | None = None  # number of the solution shown at the previous refresh
        self._drew_solution = False  # True once the panels have shown a solution
        self._aligned: tuple[int, bytes, Alignment] | None = None  # number of the solution, eyes, alignment
        delays = [round(panel.delay_ms * NS_PER_MS) for panel in settings.output.panels]
        self._delays_ns = delays if any(delays) else []  # of each panel; empty: all are in step

    def run(self, *, frames: int | None = None) -> str:
        """Refresh the panels until `frames`, the recording's end, or a stop, and return the reason."""
        reason = ""
        while not reason:
            try:
                self.refresh()
            except EndOfRecording:
                reason = "the recording has ended"
            reason = reason or self._supervisor.stop_reason()
            if frames is not None and self.stats.frames >= frames:
                reason = reason or f"reached the limit of {frames} frames"
        self.machine.update(Conditions("none", {}, presented=True, stopping=reason), now_ns=self.clock.now_ns())
        return reason

    def refresh(self) -> RefreshAccount:
        """Carry out one refresh. Raises EndOfRecording, or FatalError if the sensor has failed permanently."""
        times = RefreshTimes(self.clock, self._stage_ms)
        timing = self.pacer.predict(self.clock.now_ns())
        self._wait(timing.wake_ns, times)
        woke_ns = self.clock.now_ns()
        self._supervisor.carry_out_commands(self)
        self._receive(woke_ns)
        times.lap("sensor")
        eyes = self.viewer.at(timing.photon_ns)
        composed_ns, news = self.clock.now_ns(), self.solver.news()
        frame, limited = self._compose(timing, eyes, news)
        times.lap("track")
        report, lost = self._present(frame, due_ns=None if times.simulated else timing.present_ns)
        times.lap("present")
        if report is not None and report.held_ns:
            times.hold(report.held_ns)
        if report is not None and times.simulated:  # the lap has advanced the clock by the cost of presenting it
            report = replace(report, present_ns=self.clock.now_ns())
        photon_ns = self._presented_at(timing, report, woke_ns=woke_ns)
        request = self._aim.request(
            timing,
            eyes,
            news.solution,
            self.settings,
            composed_ns=composed_ns,
            now_ns=self.clock.now_ns(),
            flat_wanted=wants_flat(eyes, flat_asked=self.flat_asked, flatness=self._flatness.value),
            paused=self.paused,
        )
        self.solver.post(request)
        self.missing = self._missing(news, lost)
        state = self._judge(eyes, limited, shown=report is not None)
        account = self._account(timing, eyes, news, frame, report, photon_ns, state, times)
        self._report(account, frame, news.solution, times)
        return account

    def adopt(self, settings: Settings, calibration: Calibration | None = None) -> None:
        """Use other settings, and perhaps another calibration, from now on."""
        self.settings = settings
        self.viewer.adopt(settings, calibration)

    def _wait(self, wake_ns: int, times: RefreshTimes) -> None:
        for _ in range(TAKEN_IN_MOST):  # a process that has ended keeps its channel readable
            sources = [each for each in (self.samples.descriptor, self.solver.descriptor) if each is not None]
            if not self.clock.is_readable(sources, until_ns=wake_ns - UNDISTURBED_NS):
                break
            times.lap("wait")
            self._receive(self.clock.now_ns())
            self.solver.news()
            times.lap("sensor")
        self.clock.sleep_until_ns(wake_ns)
        times.lap("wait")

    def _receive(self, now_ns: int) -> None:
        for sample in self.samples.arrived(now_ns):
            self.viewer.take(sample, serial=self.samples.serial)
            for observer in self._observers:
                observer.sampled(sample)

    def _compose(self, timing: FrameTiming, eyes: EyesEstimate, news: SolverUpdate) -> tuple[PanelFrame, str]:
        """Return the frame to present, and the reason if the alignment has reached a limit, otherwise ""."""
        solution, flat = news.solution, news.flat
        target = 1.0 if eyes.eyes_m is None or self.flat_asked else 0.0
        if solution is not None and not self._drew_solution and target == 0.0:
            self._flatness.value = 0.0  # show the first picture without fading it in
        if self.paused and not self.flat_asked:  # the time of the pause must not count as a part of a blend
            target = self._flatness.value
        flatness = self._flatness.toward(target, now_ns=self.clock.now_ns())
        if solution is None or flat is None:
            flatness = self._flatness.value = 1.0 if solution is None else 0.0
        self._drew_solution = self._drew_solution or (solution is not None and flatness < 1.0)
        alignment = self._alignment(eyes, solution)
        frame = PanelFrame(
            timing.id,
            solution.layers if solution is not None else None,
            solution.number if solution is not None else 0,
            alignment.solved_from_shown,
            flat.layers if flat is not None else None,
            flat.number if flat is not None else 0,
            flatness,
            (self.stack.width_px, self.stack.height_px),
            solution.relief if solution is not None else None,
            alignment.parallax,
            self._on_monitors(timing, solution, alignment),
        )
        return frame, alignment.limited

    def _on_monitors(
        self, timing: FrameTiming, solution: Solution | None, alignment: Alignment
    ) -> tuple[tuple[F64, Parallax | None], ...]:
        """Return each panel's alignment at its own display time (`PanelFrame.on_monitors`)."""
        if not self._delays_ns or solution is None or not alignment.solved_from_shown:
            return ()
        found = {0: alignment}
        for delay_ns in set(self._delays_ns) - {0}:
            eyes = self.viewer.ahead(timing.photon_ns + delay_ns)
            found[delay_ns] = alignment
            if eyes.eyes_m is not None:
                solved_for_m, eyes_m = matched(solution, eyes)
                found[delay_ns] = align(self.stack, solved_for_m=solved_for_m, eyes_m=eyes_m)
        chosen = [found[delay_ns] for delay_ns in self._delays_ns]
        return tuple((each.solved_from_shown[n], each.parallax) for n, each in enumerate(chosen))

    def _alignment(self, eyes: EyesEstimate, solution: Solution | None) -> Alignment:
        """Align the solution to the eyes, or return its previous alignment if no eyes are known. If the layers are
        shown as solved, the alignment contains no matrices.
        """
        plan = self.settings.plan
        if solution is None or solution.solved_for_m is None or not plan.align:
            return Alignment(())
        last = self._aligned
        if eyes.eyes_m is None:
            return replace(last[2], limited="") if last is not None and last[0] == solution.number else Alignment(())
        solved_for_m, eyes_m = matched(solution, eyes)
        key = eyes_m.tobytes()
        if last is None or last[:2] != (solution.number, key):
            alignment = align(self.stack, solved_for_m=solved_for_m, eyes_m=eyes_m)
            self._aligned = last = solution.number, key, alignment
        return last[2]

    def _present(self, frame: PanelFrame, *, due_ns: int | None) -> tuple[PresentReport | None, str]:
        """Present a frame at `due_ns` or immediately; return the report and "", or None and the reason if a panel is
        lost. Both are empty before the first picture.
        """
        if frame.solved is None and frame.flat is None:
            return None, ""
        last = self.last
        unchanged = last is not None and last.account.presented and _same(frame, last.frame)
        try:
            report = self.panels.present(frame, unchanged=unchanged, due_ns=due_ns)
        except PanelLost as error:
            return None, str(error)
        self._presented = True
        return report, ""

    def _presented_at(self, timing: FrameTiming, report: PresentReport | None, *, woke_ns: int) -> int:
        """Report a refresh's fate to the pacer, and return its display time."""
        if report is None:
            return self.pacer.presented(timing, woke_ns=woke_ns, done_ns=self.clock.now_ns())
        return self.pacer.presented(
            timing, woke_ns=woke_ns, done_ns=report.present_ns, blank_ns=report.vblank_ns, held_ns=report.held_ns
        )

    def _missing(self, news: SolverUpdate, lost: str) -> dict[str, str]:
        missing = dict(news.missing)
        if lost:
            missing["panel"] = lost
        if fault := self.samples.fault() or self.viewer.warning.removeprefix("sensor: "):
            missing["sensor"] = fault
        for part in missing:
            if part not in self.missing:
                self.stats.fault(part)
        return missing

    def _judge(self, eyes: EyesEstimate, limited: str, *, shown: bool) -> State:
        parts: dict[Part, str] = {part: why for part, why in self.missing.items()}  # type: ignore[misc]
        conditions = Conditions(
            eyes.label,
            parts,
            presented=self._presented,
            flat_wanted=self.flat_asked,
            limited=limited,
            late=self._lateness.update(presented=shown, now_ns=self.clock.now_ns()),
            paused=self.paused,
        )
        before = self.machine.name
        if self.machine.update(conditions, now_ns=self.clock.now_ns()):
            reason = self.machine.reason.removeprefix(f"{', '.join(self.machine.missing)}: ")
            line = f"state: {before} -> {self.machine.name} ({reason})"
            log.info("%s", line, extra={"always": True})
        return self.machine.state

    def _account(
        self,
        timing: FrameTiming,
        eyes: EyesEstimate,
        news: SolverUpdate,
        frame: PanelFrame,
        report: PresentReport | None,
        photon_ns: int,
        state: State,
        times: RefreshTimes,
    ) -> RefreshAccount:
        solution = news.solution if report is not None and frame.flatness < 1.0 else None  # None if not visible
        ran = solution is not None and solution.number != self._shown_solution
        stage_ms = dict(times.stage_ms)
        if solution is not None and ran:
            stage_ms |= {stage: solution.stage_ms.get(stage, 0.0) for stage in SHOWN_STAGES}
            stage_ms["finish"] += solution.stage_ms.get("step", 0.0)
        if solution is not None:
            self._shown_solution = solution.number
        people = accounts_of(solution, eyes)
        solved_for_m = None if solution is None or solution.solved_for_m is None else solution.solved_for_m[:2]
        return RefreshAccount(
            frame=timing.id,
            capture_ns=eyes.capture_ns,
            predicted_for_ns=timing.photon_ns,
            present_ns=report.present_ns if report is not None else self.clock.now_ns(),
            eyes_m=people[0].eyes_m if people else None,
            eyes_label=eyes.label,
            eye_sigma_mm=eyes.sigma_m * 1e3 if eyes.eyes_m is not None else None,
            state=state,
            solution=solution.number if solution is not None else None,
            solved_for_m=people[0].solved_for_m if len(people) > 1 else solved_for_m,
            solution_age_ms=(photon_ns - solution.solved_for_ns) / NS_PER_MS if solution is not None else None,
            inference="ran" if ran else "reused" if solution is not None else "skipped",
            presented=report is not None,
            skew_ms=report.skew_ms if report is not None else 0.0,
            photon_ns=photon_ns,
            stage_ms=stage_ms,
            effort=solution.effort.name if solution is not None and solution.effort is not None else None,
            people=people,
        )

    def _report(
        self, account: RefreshAccount, frame: PanelFrame, solution: Solution | None, times: RefreshTimes
    ) -> None:
        refresh = Refresh(account, frame, solution, self.solver.facts.version)
        self.status = self._status(refresh)
        self._supervisor.refreshed(self.status)
        self.stats.add(account, overhead_ms=times.overhead_ms(), missed_blanks=self.pacer.missed)
        for observer in self._observers:
            observer.refreshed(refresh)

    def _status(self, refresh: Refresh) -> Status:
        viewer = self.viewer
        return Status(
            refresh=refresh,
            name=self.machine.name,
            reason=self.machine.reason,
            missing=self.missing,
            paused=self.paused,
            flat_asked=self.flat_asked,
            settings=self.settings,
            facts=self.solver.facts,
            live=self.solver.live,
            people_in_view=viewer.in_view,
            rejected_samples=dict(viewer.refused),
            sensor_hz=None if "sensor" in self.missing else viewer.rate_hz,
            stale_inputs=self.samples.stale_inputs,
        )

    @property
    def last(self) -> Refresh | None:
        """The latest refresh, or None before the first."""
        return None if self.status is None else self.status.refresh

    def summary(self, *, simulated: bool = False) -> dict[str, Any]:
        """Return the counts, times, model and states for summary.json (docs/contracts.md)."""
        facts = self.solver.facts
        return {
            **self.stats.summary(stale_inputs=self.samples.stale_inputs, simulated=simulated),
            "model": facts.model.name,
            "provider": facts.model.provider,
            "states": self.machine.seconds(now_ns=self.clock.now_ns()),
        }


def _same(frame: PanelFrame, before: PanelFrame) -> bool:
    """Return True if two frames show the same picture on every panel."""
    return (
        (frame.solved_version, frame.flat_version if frame.flatness > 0.0 else 0, frame.flatness)
        == (before.solved_version, before.flat_version if before.flatness > 0.0 else 0, before.flatness)
        and _same_matrices(frame.solved_from_shown, before.solved_from_shown)
        and _same_matrices([map_ for map_, _ in frame.on_monitors], [map_ for map_, _ in before.on_monitors])
    )


def _same_matrices(some: Sequence[F64], others: Sequence[F64]) -> bool:
    return len(some) == len(others) and all(np.array_equal(a, b) for a, b in zip(some, others, strict=True))
