"""Puts a run together from its settings: the composition root below the command line."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock, SimulatedClock
from runtime.config import OutputSettings, Settings
from runtime.records import RefreshAccount
from runtime.support.memory import settled
from runtime.support.priority import PRESENTER_NICENESS, niceness

if TYPE_CHECKING:
    from runtime.blackbox.recorder import Recorder
    from runtime.daemon.solver_parts import RunningSolver
    from runtime.frame.observer import Output, RunObserver
    from runtime.frame.presenter import Presenter, Supervisor
    from runtime.frame.solver_host import SolverHost
    from runtime.optics.stack import PanelStack
    from runtime.panels.base import PanelSink
    from runtime.sensor.base import SensorDriver
    from runtime.support.progress import Listener

log = logging.getLogger("phasestack.build")

SWITCH_INTERVAL_S = 0.0005  # between Python threads: the presenter must not wait long for the solver's


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What the command line says in addition to the configuration."""

    max_speed: bool = False
    measure: bool = False
    scale: float = 1.0
    keep_light: int = 0


@dataclass(frozen=True, slots=True)
class Run:
    """What was put together."""

    presenter: Presenter
    observer: RunObserver
    solver: SolverHost
    newest_parts: Callable[[], RunningSolver]
    simulated: bool

    @property
    def parts(self) -> RunningSolver:
        """The solver at present: for the status, and for tests."""
        return self.newest_parts()

    def plan_items(self) -> list[dict[str, Any]]:
        """What is left out at present; a saving or a cost that this run did not measure is None."""
        from dataclasses import asdict

        from runtime.plan.savings import Saving

        solver = self.parts.solver
        known = replace(solver.measured, reuse=Saving(saves_ms=self.presenter.stats.reuse_saves_ms()))
        return [asdict(item) for item in solver.plan_items(known)]

    def summary(self) -> dict[str, Any]:
        """summary.json (contract 5.2)."""
        return {
            **self.presenter.summary(simulated=self.simulated),
            **self.observer.means.summary(),
            "backend": self.presenter.run_cell.state.predictor.backend,
            "scene": self.presenter.run_cell.state.content.info.name,
            "plan": self.plan_items(),
        }


def scaled_stack(settings: Settings, scale: float) -> PanelStack:
    """The configured stack with `scale` times its pixels."""
    stack = settings.stack.stack()
    if scale == 1.0:
        return stack
    return replace(
        stack, width_px=max(16, round(stack.width_px * scale)), height_px=max(16, round(stack.height_px * scale))
    )


def _heard(on_start: Callable[[str], bool]) -> Listener:
    """A listener to what is read before the first refresh, which ends it when it is told to stop."""

    def heard(what: str, done: int, total: int | None) -> None:
        from runtime.errors import Stopped

        if not on_start("reading the recording"):
            raise Stopped("told to stop while starting")

    return heard


def build_run(
    settings: Settings,
    options: RunOptions,
    cleanup: ExitStack,
    *,
    supervisor: Supervisor | None = None,
    output: Output | None = None,
    on_account: Callable[[RefreshAccount], None] | None = None,
    wait_for_panels: Callable[[str], bool] | None = None,
    on_start: Callable[[str], bool] = lambda _: True,
    recorder: Recorder | None = None,
) -> Run:
    """A run ready for its first refresh; whatever it holds is closed by `cleanup`.

    wait_for_panels: asked when a panel is not there yet; True: try again. on_start: told what takes long before the
    first refresh; False: leave it. recorder: begins to watch; who gives it closes it. Raises FatalError, PanelLost.
    """
    import cv2

    from runtime.daemon.solver_parts import SolverMaker
    from runtime.eyes.calibration import load_calibration
    from runtime.eyes.detect import EyeFinder
    from runtime.frame.observer import RunObserver
    from runtime.frame.observers import Observers
    from runtime.frame.presenter import Presenter
    from runtime.frame.samples import LiveSamples, RecordedSamples, Samples
    from runtime.frame.solver_host import SimulatedSolver, total_ns
    from runtime.frame.solver_thread import SolverThread
    from runtime.frame.viewer import Viewer
    from runtime.sensor.detecting import DetectingDriver
    from runtime.sensor.registry import open_sensor
    from runtime.support.gl import offscreen_context
    from runtime.support.progress import listening

    cv2.setNumThreads(settings.model.threads or -1)
    simulated = options.max_speed
    clock: Clock = SimulatedClock() if simulated else MonotonicClock()
    stack = scaled_stack(settings, options.scale)
    calibration = load_calibration(Path(settings.calibration.file) if settings.calibration.file else None)
    for warning in calibration.warnings:
        log.warning("%s", warning)

    def make_driver() -> SensorDriver:
        latency_ms = settings.loop.sensor_latency_ms
        driver = open_sensor(settings.sensor, clock, latency_ms=latency_ms, limits=settings.limits)
        return DetectingDriver(driver, lambda: EyeFinder(settings.detector).find)

    driver = make_driver()
    samples: Samples
    if simulated:
        with listening(_heard(on_start)):  # a recording may be long to skip through
            samples = RecordedSamples(driver)
        cleanup.callback(samples.close)
    context = offscreen_context()
    cleanup.callback(context.release)
    output_settings = settings.output
    if options.scale != 1.0:  # asked for: no monitor's mode fits such a stack
        output_settings = output_settings.model_copy(update={"allow_rescaling": True})
    panels = _open_panels(output_settings, stack, clock, context, wait_for_panels)
    cleanup.callback(panels.close)
    maker = SolverMaker(settings, stack, calibration, on_start=on_start, panels_group=lambda: panels.group)
    solver: SolverHost
    if simulated:
        solver = SimulatedSolver(maker(context=context, simulated=True), clock)
        cleanup.callback(solver.close)
    else:
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        thread = SolverThread(
            maker,
            clock,
            late_s=settings.loop.solver_late_s,
            abandon_s=settings.loop.solver_abandon_s,
            first_cost_ns=total_ns(settings.loop.simulated_stage_ms),
        )
        solver = thread
        cleanup.callback(solver.close)
        thread.wait_ready(lambda: on_start("loading content and model"), most_s=settings.limits.start_s)
        samples = LiveSamples(make_driver, settings.sensor, clock)
        cleanup.callback(samples.close)
    run = maker.run
    if run is None:
        from runtime.errors import Stopped

        raise Stopped("told to stop while starting")
    viewer = Viewer(settings, calibration, front_m=max(stack.x_m), in_stack_frame=driver.capabilities.in_stack_frame)
    observer = RunObserver(
        stack,
        solver,
        fov_deg=settings.content.fov_deg,
        measure=options.measure,
        evaluate_every=settings.loop.evaluate_every if options.measure else 0,
        keep_light=options.keep_light,
        output=output,
        on_account=on_account,
        simulated=simulated,
    )
    presenter = Presenter(
        run,
        stack,
        clock=clock,
        pacer=_pacer(settings, panels),
        samples=samples,
        viewer=viewer,
        solver=solver,
        panels=panels,
        stage_ms=settings.loop.simulated_stage_ms,
        supervisor=supervisor,
        observer=observer if recorder is None else Observers(observer, recorder),
    )
    if recorder is not None:
        in_stack_frame = driver.capabilities.in_stack_frame
        recorder.watches(presenter, stack=stack, simulated=simulated, in_stack_frame=in_stack_frame)
    if not simulated:
        cleanup.enter_context(settled())
        cleanup.enter_context(niceness(PRESENTER_NICENESS))  # this thread's, once all others have been started
    return Run(presenter, observer, solver, lambda: _newest(maker), simulated)


def _newest(maker: Any) -> RunningSolver:
    parts: RunningSolver = maker.parts
    return parts


def _pacer(settings: Settings, panels: PanelSink) -> Any:
    from runtime.frame.pacing import Pacer

    period_ns = panels.period_ns or round(NS_PER_S / settings.loop.rate_hz)
    work_ms = _refresh_ms(settings.loop.simulated_stage_ms)
    return Pacer(
        period_ns=period_ns,
        photon_ns=round(settings.loop.scanout_ms * NS_PER_MS),
        work_ns=round(work_ms * NS_PER_MS),
    )


def _refresh_ms(stage_ms: Mapping[str, float]) -> float:
    return sum(stage_ms.get(stage, 0.0) for stage in ("sensor", "track", "present"))


def _open_panels(
    settings: OutputSettings, stack: PanelStack, clock: Clock, context: Any, wait: Callable[[str], bool] | None
) -> PanelSink:
    from runtime.errors import PanelLost
    from runtime.panels.registry import open_panels

    while True:
        try:
            return open_panels(settings, stack, clock, context)
        except PanelLost as error:
            if wait is None or not wait(str(error)):
                raise
