"""Create all of a run's parts from the settings (composition root)."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from runtime.browser.link import BrowserLink, Reporting
from runtime.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock, SimulatedClock
from runtime.config import Settings
from runtime.daemon import solver_worker
from runtime.daemon.pose import PoseSender
from runtime.daemon.programs import Programs
from runtime.daemon.solver_parts import RunningSolver, SolverSetup
from runtime.errors import InputError, PanelLost, Stopped
from runtime.eyes.calibration import load_calibration
from runtime.eyes.detect import EyeFinder
from runtime.frame.kept_light import Output
from runtime.frame.measuring import MeasuringProcess
from runtime.frame.messages import Facts, Live
from runtime.frame.observer import RunObserver
from runtime.frame.pacing import Pacer
from runtime.frame.presenter import Presenter, Supervisor
from runtime.frame.solver_host import SimulatedSolver, SolverHost
from runtime.frame.solver_process import Known, SolverProcess
from runtime.frame.targets import TargetDrawer
from runtime.frame.viewer import Viewer
from runtime.model.backends import Wanted
from runtime.optics.stack import PanelStack
from runtime.panels.base import PanelSink
from runtime.panels.registry import OffscreenPanels, open_panels
from runtime.plan.savings import Saving, make_plan
from runtime.records import Effort, RefreshAccount
from runtime.sensor.browser import BrowserCamera, BrowserEyes
from runtime.sensor.live import LiveSamples, SensorProcess, SensorSetup, SensorThread
from runtime.sensor.registry import open_sensor
from runtime.sensor.samples import RecordedSamples, Samples
from runtime.support.background import before_all_others
from runtime.support.gl import offscreen_context
from runtime.support.process import usage
from runtime.support.untrusted_input import MIB

log = logging.getLogger("phasestack.build")

STEP_S = 10.0  # a solver that needs longer for a solution has hung
MACHINE_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
SOLVER_MEMORY_BYTES = round(0.6 * MACHINE_BYTES) // MIB * MIB  # without the memory shared with the presenter

# Figures in summary.json that are determined by the configuration if the clock is simulated.
SIMULATED_FIGURES = (
    "seconds", "fps", "solutions_per_s", "interval_ms", "photon_ms", "stage_ms", "overhead_ms", "skew_ms",
    "solution_age_ms", "efforts",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class RunOptions:
    """A run's options that can be set only on the command line."""

    max_speed: bool = False  # play a recording without waiting, against a simulated clock
    measure: bool = False  # measure the quality of a sample of refreshes
    scale: float = 1.0  # factor applied to the panels' size in pixels
    keep_light: int = 0  # N: write every N-th refresh's layers; 0: write none
    frames: int | None = None  # stop after this many refreshes; None: run to the end
    out: Path | None = None  # folder for the run's files
    browser: BrowserLink | None = None  # link to a page that shows the panels and may serve as the sensor
    until: Callable[[], str] = str  # returns the reason to stop, or "" to continue
    fixed: Effort | None = None  # effort of every solution if model.effort is "full"; None: all of the model's steps


@dataclass(frozen=True, slots=True)
class Run:
    """A run built by `build_run`, with access to its savings and summary."""

    presenter: Presenter
    observer: RunObserver
    measuring: MeasuringProcess
    programs: Programs | None  # None on a simulated clock, where the solver serves programs itself

    @property
    def simulated(self) -> bool:
        return self.programs is None

    def plan_items(self, facts: Facts, live: Live) -> list[dict[str, Any]]:
        """Return the savings in use as dictionaries. Any time or cost that was not measured is None."""
        known = replace(live.measured, reuse=Saving(saves_ms=self.presenter.stats.reuse_saves_ms()))
        plan = make_plan(facts.info, facts.settings, seeing=live.seeing, measured=known)
        return [asdict(item) for item in plan.items]

    def processes(self) -> list[dict[str, Any]]:
        """Return the current use of memory and processor time by each of the run's processes."""
        own = {"role": "presenter", "restarts": 0, **usage(os.getpid())}
        programs = [] if self.programs is None else self.programs.status()
        solver, sensor = self.presenter.solver.status(), self.presenter.samples.status()
        return [own, *solver, *sensor, *programs, *self.measuring.status()]

    def summary(self) -> dict[str, Any]:
        """Return the contents of summary.json (docs/contracts.md)."""
        solver = self.presenter.solver
        return {
            "clock": "simulated" if self.simulated else "real",
            "configured": list(SIMULATED_FIGURES) if self.simulated else [],  # figures that were not measured
            **self.presenter.summary(simulated=self.simulated),
            **self.observer.summary(),
            "backend": solver.facts.backend,
            "scene": solver.facts.info.name,
            "plan": self.plan_items(solver.facts, solver.live),
        }


def scaled_stack(settings: Settings, scale: float) -> PanelStack:
    """Return the configured stack, with its width and height in pixels multiplied by `scale`."""
    stack = settings.stack.stack()
    if scale == 1.0:
        return stack
    return replace(
        stack, width_px=max(16, round(stack.width_px * scale)), height_px=max(16, round(stack.height_px * scale))
    )


class Host(Supervisor):
    """Callbacks used while a run starts, in addition to those in `Supervisor`. The defaults do nothing."""

    recorder: Any = None  # additional observer; its `watches` is called before the first refresh

    def starting(self, doing: str) -> bool:
        """Report a startup step, such as "opening panels". False cancels loading content and model."""
        return True

    def wait_for_panel(self, why: str) -> bool:
        """Called when a panel is missing. Returns True after a pause to try again, or False to give up."""
        return False

    def watches(self, run: Run) -> None:
        """Called with the complete run before the first refresh."""


def build_run(
    settings: Settings,
    options: RunOptions,
    cleanup: ExitStack,
    host: Host | None = None,
    *,
    output: Output | None = None,
    on_account: Callable[[RefreshAccount], None] | None = None,
) -> Run:
    """Build a run that is ready for its first refresh. `cleanup` closes all of its parts.

    `host` has callbacks during startup and, as the presenter's supervisor, at each refresh; `on_account` gets each
    refresh's account. Raises FatalError for a setting or a file, PanelLost if the host does not wait for a missing
    panel, and Stopped if it has cancelled startup.
    """
    host = host or Host()
    if options.scale != 1.0 and settings.output.kind != "offscreen":
        raise InputError("run", "--scale", "requires --headless because monitors cannot show a scaled stack")
    cv2.setNumThreads(settings.model.threads or -1)
    simulated, stage_ms = options.max_speed, settings.loop.simulated_stage_ms
    clock: Clock = SimulatedClock() if simulated else MonotonicClock()
    stack = scaled_stack(settings, options.scale)
    calibration = load_calibration(Path(settings.calibration.file) if settings.calibration.file else None)
    for warning in calibration.warnings:
        log.warning("%s", warning)

    samples: Samples
    if simulated:
        # On a simulated clock, a run would never end if its recording began again.
        recording = settings.sensor.model_copy(update={"loop": False})
        driver = open_sensor(recording, clock, latency_ms=settings.loop.sensor_latency_ms)
        samples = RecordedSamples(driver)
        in_stack_frame = driver.capabilities.in_stack_frame
    else:  # first, because the processes start while the panels are being opened
        samples = sensor = start_sensor(settings, clock, options.browser)
    cleanup.callback(samples.close)
    solver: SolverHost
    measuring = MeasuringProcess(stack)
    cleanup.callback(measuring.close)
    if not simulated:
        lost: list[PanelSink] = []
        programs = Programs()
        cleanup.callback(programs.close)
        solver = process = start_solver(
            settings,
            stack,
            clock,
            programs=programs,
            contexts_lost=lambda: sum(sink.contexts_lost for sink in lost),
        )
        cleanup.callback(solver.close)
        if options.measure:
            measuring.begin()
    host.starting("creating the OpenGL context")
    context = offscreen_context()
    cleanup.callback(context.release)
    panels: PanelSink = (
        _open_panels(settings, stack, clock, context, host)
        if options.browser is None
        else OffscreenPanels(clock, name="browser")
    )
    cleanup.callback(panels.close)
    if simulated:
        solver = SimulatedSolver(RunningSolver(SolverSetup(settings, stack, simulated=True), context=context), clock)
        cleanup.callback(solver.close)
    else:
        lost.append(panels)
        process.wait_ready(lambda: host.starting("loading the scene and the model"))
        if not process.is_known:
            raise Stopped("stopped during startup")
        sensor.start(lambda: host.starting("starting the sensor"))
        in_stack_frame = sensor.capabilities.in_stack_frame
    observer = RunObserver(
        stack,
        TargetDrawer(solver),
        measuring,
        evaluate_every=settings.loop.evaluate_every if options.measure else None,
        keep_light=options.keep_light,
        output=output,
        on_account=on_account,
        simulated=simulated,
        newest=options.browser is not None,
    )
    pacer = Pacer(
        period_ns=panels.period_ns or round(NS_PER_S / settings.loop.rate_hz),
        photon_ns=round(settings.loop.scanout_ms * NS_PER_MS),
        work_ns=round(sum(stage_ms.get(stage, 0.0) for stage in ("sensor", "track", "present")) * NS_PER_MS),
    )
    pose = []
    if (settings.pose.port or settings.pose.lsl) and not simulated:
        pose.append(PoseSender(settings.pose))
        cleanup.callback(pose[0].close)
    presenter = Presenter(
        settings,
        stack,
        clock=clock,
        pacer=pacer,
        samples=samples,
        viewer=Viewer(settings, calibration, front_m=max(stack.x_m), in_stack_frame=in_stack_frame),
        solver=solver,
        panels=panels,
        stage_ms=stage_ms,
        supervisor=host,
        observers=[observer, *pose] if host.recorder is None else [observer, *pose, host.recorder],
        fixed=options.fixed,
    )
    if host.recorder is not None:
        host.recorder.watches(presenter, in_stack_frame=in_stack_frame)
    if not simulated:
        cleanup.enter_context(before_all_others())  # affects only this thread, because all others have already started
    run = Run(presenter, observer, measuring, None if simulated else programs)
    host.watches(run)
    return run


def start_sensor(settings: Settings, clock: Clock, link: BrowserLink | None = None) -> LiveSamples:
    """Return a live sensor, maybe a page, that is not polled yet. Raises TransientError without a thread."""
    make_driver = partial(open_sensor, settings.sensor, clock, latency_ms=settings.loop.sensor_latency_ms)
    make_finder = partial(EyeFinder, settings, most_people=settings.sought_people)
    if link is None:
        return SensorProcess(SensorSetup(make_driver, settings.sensor, clock, make_finder))
    shown = partial(Reporting, make_finder)
    sensor: LiveSamples
    if link.mode.is_sensor or link.mode.is_camera:
        driver = BrowserEyes if link.mode.is_sensor else BrowserCamera
        sensor = SensorThread(SensorSetup(partial(driver, link, clock), settings.sensor, clock, shown))
    else:
        sensor = SensorProcess(SensorSetup(make_driver, settings.sensor, clock, shown))
    sensor.on_found = link.report
    return sensor


def start_solver(
    settings: Settings, stack: PanelStack, clock: Clock, *, programs: Programs, contexts_lost: Callable[[], int]
) -> SolverProcess:
    """Start a solver's process, which is replaced when `contexts_lost` changes."""

    def setup(known: Known) -> SolverSetup:
        if known.facts is None:
            return SolverSetup(settings, stack, programs=programs.descriptor, step_s=STEP_S)
        facts = known.facts
        device: Wanted = "gl" if facts.backend == "gl" else "cpu"
        return SolverSetup(
            facts.settings,
            stack,
            device=device,
            version=facts.version,
            scene=facts.scene,
            programs=programs.descriptor,
            first_number=known.next_number,
            costs=known.first,
            step_s=STEP_S,
        )

    role = solver_worker.role(SOLVER_MEMORY_BYTES)
    return SolverProcess(role, stack, setup, clock, contexts_lost=contexts_lost, files=(programs.descriptor,))


def _open_panels(settings: Settings, stack: PanelStack, clock: Clock, context: Any, host: Host) -> PanelSink:
    while True:
        host.starting("opening the panels")
        try:
            return open_panels(settings.output, stack, clock, context)
        except PanelLost as error:
            if not host.wait_for_panel(str(error)):
                raise
