"""The supervised run: signals, systemd, the status socket, reload. Imported when `run` starts."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from runtime.blackbox.location import black_box_folder, state_folder
from runtime.blackbox.recorder import MIB, Plan, Recorder
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import Overrides, Settings, changed, load_settings
from runtime.content.placed import placed_source, placing_of
from runtime.daemon.build import Run, RunOptions
from runtime.daemon.commands import PLACING, Command
from runtime.daemon.drive import drive, print_summary
from runtime.daemon.names import check_recording, library_scenes, model_names, scene_from_here, scene_names
from runtime.daemon.notify import Notifier, may_restart
from runtime.daemon.reconfigure import Reconfiguration
from runtime.daemon.server import StatusServer, open_status_server
from runtime.daemon.signals import Signals
from runtime.errors import InputError, PanelLost, PhasestackError, Stopped, TransientError, one_line
from runtime.frame.presenter import Presenter
from runtime.records import RefreshAccount, State
from runtime.support import logs
from runtime.support.artifacts import write_text
from runtime.support.transient import MayPass, may_pass
from runtime.support.version import version

log = logging.getLogger("phasestack.daemon")

PANEL_RETRY_S = 1.0
START_EXTENSION_S = 10.0
NEEDS_RESTART = ("stack", "sensor", "detector", "output", "service")


class RestartAsked(TransientError):
    """The run has ended so that the service manager starts it again."""


class Daemon:
    """The run's supervisor: carries what operators ask in and news out, once a refresh."""

    def __init__(
        self,
        config: Path | None,
        overrides: Overrides,
        *,
        signals: Signals,
        notifier: Notifier,
        server: StatusServer | None,
        metrics: Any | None,
        recorder: Recorder | None = None,
    ) -> None:
        self._recorder = recorder
        self._config, self._overrides = config, overrides
        self._signals, self._notifier, self._server, self._metrics = signals, notifier, server, metrics
        self.run: Run | None = None  # set when it has been put together
        self._faults_told: dict[str, int] = {}
        self._missed_told = 0
        self._change: Reconfiguration | None = None
        self._asked_by: Command | None = None  # for the change under way; None: a signal
        self._refused = ""  # why the last change was refused, until one is taken
        self._configured_placing: dict[str, Any] = {}
        self.restarting = False  # asked for by an operator

    def stop_reason(self) -> str:
        if self.restarting:
            return "restart asked for"
        return f"{self._signals.stop} received" if self._signals.stop else ""

    def carry_out_commands(self, presenter: Presenter) -> None:
        if self._signals.take_reload():
            self._notifier.reloading()
            self._reload(presenter, None)
        while self._server is not None and not self._server.commands.empty():
            command = self._server.commands.get()
            if command.take():  # else it was refused meanwhile: never done later
                try:
                    self._carry_out(command, presenter)
                except Exception as error:  # one request must not end what everybody looks at
                    log.exception("%s: unexpected error", command.name)
                    command.refuse(f"unexpected error ({type(error).__name__}): see the log")
        if self._change is not None and self._change.finished:
            change, self._change = self._change, None
            if not change.problem:
                state = presenter.run_cell.state
                log.info("changed: scene %s, model %s", state.content.info.name, state.predictor.name)
                if state.content.info.stand_in and self._asked_by is not None:
                    self._asked_by.told["note"] = f"shown: {state.content.info.name}"
            self._answer(self._asked_by, change.problem)

    def refreshed(self, presenter: Presenter, account: RefreshAccount) -> None:
        machine = presenter.machine
        if account.presented:
            self._notifier.ready()
        self._notifier.status(f"{machine.name} ({machine.reason})")
        self._notifier.refreshed(machine.state, machine.missing, presented=account.presented)
        if self._server is not None:
            self._server.publish(lambda: snapshot(self.run, presenter, account) | self._loading() | self._box())
        if self._metrics is not None:
            self._metrics.refresh(account)
            self._metrics.missed_blanks(presenter.stats.missed_blanks - self._missed_told)
            self._missed_told = presenter.stats.missed_blanks
            for part, count in presenter.stats.faults.items():
                for _ in range(count - self._faults_told.get(part, 0)):
                    self._metrics.fault(part)
                self._faults_told[part] = count

    def abandon_change(self) -> None:
        """The run is over: what is being loaded is no longer wanted."""
        if self._change is not None:
            self._change.abandon()
            self._change = None

    def watches(self, run: Run) -> None:
        """The run that it supervises."""
        self.run = run
        self._configured_placing = _placing_in(run.presenter.run_cell.state.settings)

    def wait_for_panels(self, why: str) -> bool:
        """A panel is not there yet: under a supervisor wait for it, by hand refuse."""
        if not self._notifier.supervised or self._signals.stop:
            return False
        log.warning("waiting for a panel: %s", why)
        self._notifier.extend_start(START_EXTENSION_S)
        self._tell_start(f"waiting for a panel: {why}")
        time.sleep(PANEL_RETRY_S)
        return not self._signals.stop

    def starting(self, doing: str) -> bool:
        """Something before the first frame takes long: ask for more time. False: told to stop."""
        self._notifier.extend_start(START_EXTENSION_S)
        self._tell_start(doing)
        return not self._signals.stop

    def _tell_start(self, doing: str) -> None:
        """Before the first refresh there is no account yet, but a reason."""
        self._notifier.status(f"starting ({doing})")
        if self._server is not None:
            self._server.publish(lambda: {"state": str(State.STARTING), "reason": doing})

    def _loading(self) -> dict[str, str]:
        """What is being loaded, and why the last change was refused; for the status."""
        change, told = self._change, {}
        if change is not None:
            told["loading"] = change.progress
        if self._refused:
            told["refused"] = self._refused
        return told

    def _box(self) -> dict[str, Any]:
        """The black box; for the status."""
        return {"blackbox": self._recorder.describe()} if self._recorder is not None else {}

    def _carry_out(self, command: Command, presenter: Presenter) -> None:
        match command.name:
            case "pause":
                presenter.paused = True
                command.done()
            case "resume":
                presenter.paused = presenter.flat_asked = False
                command.done()
            case "flat":
                presenter.flat_asked = True
                command.done()
            case "reload":
                self._reload(presenter, command)
            case "scene":
                self._show(presenter, command.value, command)
            case "playlist":
                try:
                    path = self._written_playlist(command.value)
                except (OSError, ValueError, InputError) as error:  # no room, or a name that is no text
                    command.refuse(f"the playlist can't be written ({one_line(str(error), most=120)})")
                else:
                    self._show(presenter, str(path), command)
            case "place":
                self._place(presenter, command)
            case "next":
                self._skip(presenter, command)
            case "model":
                self._set_model(presenter, command)
            case "budget":
                self._set_budget(presenter, command.value)
                command.done()
            case "restart":
                self._restart(command)
            case "blackbox":
                self._write_black_box(command)

    def _show(self, presenter: Presenter, scene: str, command: Command) -> None:
        settings = presenter.run_cell.state.settings
        # Another scene stands as the configuration has it, not as the one before it was moved.
        content = settings.content.model_copy(update={"scene": scene, **self._configured_placing})
        shown = settings.model_copy(update={"content": content})
        self._begin(presenter, shown, command, reload_content=True)

    def _written_playlist(self, shows: list[dict[str, Any]]) -> Path:
        """The operator's list as a file, which `content.scene` can name for good. Raises OSError."""
        text = "# Shown from the page or by a program; made anew each time.\n"
        for show in shows:
            scene = json.dumps(scene_from_here(show["scene"]), ensure_ascii=False)  # a TOML string too
            text += f"\n[[show]]\nscene = {scene}\nseconds = {show['seconds']!r}\n"
        path = state_folder() / "playlist.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
        return path

    def _place(self, presenter: Presenter, command: Command) -> None:
        """Move the scene: settings and content change together, once the solver has seen that something is visible."""
        values = command.value or self._configured_placing
        try:
            changed(presenter.run_cell.state.settings, "content", values, source="place")
        except PhasestackError as error:
            command.refuse(str(error))
            return

        def place(parts: Any) -> bool:
            state, now_ns = parts.run.state, presenter.clock.now_ns()
            settings = changed(state.settings, "content", values, source="place")
            placing = placing_of(settings.content)
            try:
                source = placed_source(state.content, placing, presenter.stack, time_ns=now_ns)
            except PhasestackError as error:
                self._answer(command, str(error))
            else:
                parts.run.replace(settings=settings, content=source)
                self._answer(command, "")
            return True

        presenter.solver.do(place)

    def _skip(self, presenter: Presenter, command: Command) -> None:
        def skip(parts: Any) -> bool:
            done = parts.run.state.content.skip(time_ns=presenter.clock.now_ns())
            self._answer(command, "" if done else "there is no next one: what is shown is no playlist, or its last")
            return True

        presenter.solver.do(skip)

    def _set_model(self, presenter: Presenter, command: Command) -> None:
        settings = presenter.run_cell.state.settings
        try:
            self._begin(presenter, changed(settings, "model", {"name": command.value}, source="model"), command)
        except PhasestackError as error:
            self._answer(command, str(error))

    def _restart(self, command: Command) -> None:
        """Stop in a way after which the service manager starts it again; where nobody would, refuse."""
        if not may_restart():
            command.refuse(
                "nothing would start it again: it is not run by a unit with Restart= (see docs/operation.md)"
            )
            return
        command.done()
        self.restarting = True

    def _write_black_box(self, command: Command) -> None:
        """What the black box keeps, to a file; the answer comes once it is there."""

        def tell(problem: str, path: Path | None) -> None:
            if problem:
                command.refuse(problem)
            else:
                command.told["file"] = str(path)
                command.done()

        if self._recorder is None:
            command.refuse("this run has no black box")
        else:
            self._recorder.save("asked for", tell)

    def _set_budget(self, presenter: Presenter, budget_ms: float) -> None:
        """In force at once; which level holds it is measured beside the solver, where it isn't known yet."""
        presenter.run_cell.replace(settings=_with_budget(presenter.run_cell.state.settings, budget_ms))
        if self._change is not None:
            self._change.settings = _with_budget(self._change.settings, budget_ms)

        def tell(parts: Any) -> bool:
            parts.budget.changed()
            return True

        presenter.solver.do(tell)

    def _reload(self, presenter: Presenter, command: Command | None) -> None:
        """Read the configuration again."""
        try:
            settings = self._overrides.applied(load_settings(self._config))
        except PhasestackError as error:
            self._answer(command, str(error))
            return
        present = presenter.run_cell.state.settings
        frozen = [name for name in NEEDS_RESTART if getattr(settings, name) != getattr(present, name)]
        if frozen:
            self._answer(command, f"{self._config}: {frozen[0]}: a change needs a restart of the service")
        else:
            self._configured_placing = _placing_in(settings)
            self._begin(presenter, settings, command)

    def _begin(
        self, presenter: Presenter, settings: Settings, command: Command | None, *, reload_content: bool = False
    ) -> None:
        """Load what the settings change; what was being loaded is overtaken."""
        if self._change is not None:
            self._change.abandon()
            self._change = None
            self._answer(self._asked_by, "overtaken by a newer change")
        present = presenter.run_cell.state.settings
        try:
            change = Reconfiguration(settings, present, presenter.stack, reload_content=reload_content)
        except PhasestackError as error:
            self._answer(command, str(error))
            return
        self._change, self._asked_by = change, command
        presenter.solver.do(change.advance)

    def _answer(self, command: Command | None, problem: str) -> None:
        """What became of a change: to who asked for it, to the log and to the status."""
        self._refused = problem
        if problem:
            log.error("refused, what was there stays: %s", problem)
        if command is None:
            self._notifier.reloaded()
        elif problem:
            command.refuse(problem)
        else:
            command.done()


def _placing_in(settings: Settings) -> dict[str, Any]:
    """What `place` may change, as it is in the settings."""
    return settings.content.model_dump(include=set(PLACING))


def _with_budget(settings: Settings, budget_ms: float) -> Settings:
    return settings.model_copy(update={"model": settings.model.model_copy(update={"budget_ms": budget_ms})})


def snapshot(run: Run | None, presenter: Presenter, account: RefreshAccount) -> dict[str, Any]:
    """What `status` answers."""
    machine, stats, state = presenter.machine, presenter.stats, presenter.run_cell.state
    counted = stats.summary(stale_inputs=presenter.samples.stale_inputs, nearly=True)
    return {
        "state": machine.name,
        "reason": machine.reason,
        "missing": presenter.missing,
        "paused": presenter.paused,
        "flat_asked": presenter.flat_asked,
        "scene": state.settings.content.scene,
        "content": state.content.info.name,
        "content_problem": state.content.problem,
        "placing": _placing_in(state.settings),
        "playlist": state.content.describe(time_ns=presenter.clock.now_ns()),
        "plan": run.plan_items() if run is not None else [],
        "model": state.predictor.name,
        "model_asked": state.settings.model.name,
        "provider": state.predictor.provider,
        "backend": state.predictor.backend,
        "backend_why": run.parts.backend.why if run is not None else "",
        "budget": run.parts.budget.describe() if run is not None else None,
        "panels": presenter.panels.name,
        "eyes_m": account.eyes_m,
        "eyes_label": account.eyes_label,
        "eye_sigma_now_mm": account.eye_sigma_mm,
        "solution": account.solution,
        "solution_age_now_ms": account.solution_age_ms,
        "photon_now_ms": (account.photon_ns - account.capture_ns) / NS_PER_MS if account.capture_ns else None,
        "rejected_samples": {
            "outlier": presenter.viewer.outliers,
            **presenter.viewer.dropped,
            **presenter.viewer.implausible,
            **presenter.samples.refused_inputs,
        },
        "sensor_hz": presenter.viewer.rate_hz if "sensor" not in presenter.missing else None,
        "log_lines_lost": logs.lost(),
        **stats.rates_now(),
        **counted,
    }


def about(run: Run | None) -> dict[str, Any]:
    """What does not change while it runs, and which scenes there are: for the page."""
    if run is None:
        return {}
    settings, stack = run.presenter.run_cell.state.settings, run.presenter.stack
    return {
        "version": version(),
        "stack": {"width_m": stack.width_m, "height_m": stack.height_m, "x_m": stack.x_m},
        "viewing_m": settings.calibration.viewing_m,
        "viewing_side_deg": settings.calibration.viewing_side_deg,
        "viewing_up_deg": settings.calibration.viewing_up_deg,
        "models": model_names(),
        "may_restart": may_restart(),
        "scenes": (*scene_names(), *library_scenes(settings.content)),
    }


@contextmanager
def _recorder(settings: Settings, *, simulated: bool, record: Path | None, images: bool) -> Iterator[Recorder | None]:
    """The run's black box; None where nobody wants one. Where the run ends with an error, it is written."""
    service = settings.service
    if simulated and record is None:
        yield None
        return
    plan = Plan(
        minutes=0.0 if simulated else service.blackbox_minutes,
        most_bytes=round(service.blackbox_mib * MIB),
        folder=black_box_folder(service.blackbox_folder),
        files=service.blackbox_files,
        record=record,
        record_bytes=round(settings.sensor.record_max_mib * MIB),
        images=images,
    )
    recorder = Recorder(plan)
    try:
        yield recorder
    except (Stopped, InputError):  # the latter before anything ran
        recorder.close()
        raise
    except Exception as error:
        recorder.close(crashed=one_line(f"{type(error).__name__}: {error}"))
        raise
    finally:
        recorder.close()


def run_daemon(
    config: Path | None,
    overrides: Overrides,
    *,
    frames: int | None,
    max_speed: bool,
    out: Path | None,
    scale: float,
    quiet: bool,
    keep_light: int = 0,
    record: Path | None = None,
    record_images: bool = False,
) -> dict[str, Any]:
    """The whole life of `phasestack run`; answers the summary.

    Raises FatalError where the configuration or a file is wrong, TransientError where starting again may help.
    """
    try:
        options = RunOptions(max_speed, out is not None, scale, keep_light)
        return _lived(config, overrides, frames, options, out, quiet, record=record, record_images=record_images)
    except Exception as error:
        if isinstance(error, TransientError) or not may_pass(error):
            raise
        raise MayPass(f"{str(error) or type(error).__name__} (this may pass: start again)") from error


def _lived(
    config: Path | None,
    overrides: Overrides,
    frames: int | None,
    options: RunOptions,
    out: Path | None,
    quiet: bool,
    *,
    record: Path | None,
    record_images: bool,
) -> dict[str, Any]:
    settings = overrides.applied(load_settings(config))
    check_recording(settings, source=config or "run")  # before seconds go into content and models
    logs.configure(settings.service)
    clock = MonotonicClock()
    with ExitStack() as cleanup:
        signals = cleanup.enter_context(Signals())
        notifier = Notifier(clock)
        cleanup.callback(notifier.close)
        server = (
            None
            if options.max_speed
            else open_status_server(settings.service, clock=clock, supervised=notifier.supervised)
        )
        if server is not None:
            cleanup.callback(server.close)
        metrics = _metrics(settings.service.metrics_port, cleanup)
        recorder = cleanup.enter_context(
            _recorder(settings, simulated=options.max_speed, record=record, images=record_images)
        )
        daemon = Daemon(
            config, overrides, signals=signals, notifier=notifier, server=server, metrics=metrics, recorder=recorder
        )
        if server is not None and recorder is not None:
            server.lookups |= {
                "pictures": recorder.look_at_pictures,
                "log": recorder.look_at_log,
                "about": lambda: about(daemon.run),
            }
        try:
            summary = drive(
                settings,
                options,
                out=out,
                frames=frames,
                total=frames,
                progress=options.max_speed and not quiet,
                supervisor=daemon,
                wait_for_panels=daemon.wait_for_panels,
                on_start=daemon.starting,
                on_built=daemon.watches,
                recorder=recorder,
            )
        except Stopped as reason:
            summary = {"stopped": str(reason)}
        except PanelLost:
            if not signals.stop:
                raise
            summary = {"stopped": daemon.stop_reason()}  # told so while it waited for a panel
        daemon.abandon_change()
        notifier.stopping(summary["stopped"])
    log.info("stopped: %s", summary["stopped"])
    if daemon.restarting:
        raise RestartAsked("an operator asked for a restart")
    if not quiet and not notifier.supervised and "frames" in summary:
        print_summary(summary, out)
    return summary


def _metrics(port: int, cleanup: ExitStack) -> Any | None:
    """None where they are off, or can't be served: the display does not go dark for its figures."""
    if not port:
        return None
    from runtime.daemon.metrics import Metrics

    metrics = Metrics()
    try:
        metrics.serve(port)
    except InputError as error:
        log.error("no metrics: %s", error)
        return None
    cleanup.callback(metrics.close)
    return metrics
