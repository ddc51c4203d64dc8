"""The supervised run: signals, systemd, the status socket, reload. Imported when `run` starts."""

from __future__ import annotations

import json
import logging
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from runtime.blackbox.location import black_box_folder, state_folder
from runtime.blackbox.recorder import ASKED, Recorder
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import ServiceSettings, Settings, changed
from runtime.content.placed import placed_source, placing_of
from runtime.daemon.build import Host, Run, RunOptions
from runtime.daemon.commands import PLACING, Command
from runtime.daemon.drive import drive
from runtime.daemon.metrics import Metrics
from runtime.daemon.names import check_recording, library_scenes, model_names, scene_from_here, scene_names
from runtime.daemon.notify import Notifier
from runtime.daemon.pictures import pictures_of
from runtime.daemon.reconfigure import Reconfiguration
from runtime.daemon.server import StatusServer, open_status_server
from runtime.daemon.signals import Signals
from runtime.errors import ContextLost, InputError, PanelLost, PhasestackError, Stopped, TransientError, one_line
from runtime.frame.presenter import Presenter
from runtime.records import RefreshAccount, State
from runtime.support import logs
from runtime.support.artifacts import write_text
from runtime.support.transient import RetryableError, is_retryable
from runtime.support.version import version

log = logging.getLogger("phasestack.daemon")

PANEL_RETRY_S = 1.0
START_EXTENSION_S = 10.0
NEEDS_RESTART = ("stack", "sensor", "output", "service")
Chosen = dict[tuple[str, str], Any]  # section and key of a setting: what an operator chose while it runs


class Daemon(Host):
    """The run's supervisor: carries what operators ask in and news out, once a refresh."""

    def __init__(
        self,
        read_settings: Callable[[], Settings],
        *,
        signals: Signals,
        notifier: Notifier,
        server: StatusServer | None = None,
        metrics: Metrics | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        """read_settings: the configuration as it is now; raises InputError."""
        self._read_settings = read_settings
        self._signals, self._notifier, self._server, self._metrics = signals, notifier, server, metrics
        self._recorder = recorder
        self.run: Run | None = None  # set when it has been put together
        self._configured = Settings()  # as last read
        self._chosen: Chosen = {}  # by an operator, in force over the configuration
        self._change: Reconfiguration | None = None
        self._asked_by: Command | None = None  # for the change under way; None: a signal
        self._pending: tuple[Settings, Chosen] = (self._configured, {})  # what these are after the change under way
        self._refused = ""  # why the last change was refused, until one is taken

    def stop_reason(self) -> str:
        return f"{self._signals.stop} received" if self._signals.stop else ""

    def carry_out_commands(self, presenter: Presenter) -> None:
        if self._signals.take_reload():
            self._notifier.reloading()
            self._attempt(presenter, None, self._reload)
        while self._server is not None and not self._server.commands.empty():
            command = self._server.commands.get()
            if command.take():  # else it was refused meanwhile: never done later
                self._attempt(presenter, command, self._carry_out)
        if self._change is not None and self._change.finished:
            change, self._change = self._change, None
            state = presenter.run_cell.state
            if not change.problem:
                self._configured, self._chosen = self._pending
                log.info("changed: scene %s, model %s", state.content.info.name, state.predictor.name)
            self._answer(presenter, self._asked_by, change.problem)

    def _attempt(self, presenter: Presenter, command: Command | None, work: Callable[..., None]) -> None:
        """What is asked for; whatever goes wrong with one request does not end what everybody looks at."""
        try:
            work(presenter, command)
        except PhasestackError as error:
            self._answer(presenter, command, str(error))
        except Exception as error:
            log.exception("%s: unexpected error", command.name if command is not None else "reload")
            self._answer(presenter, command, f"unexpected error ({type(error).__name__}): see the log")

    def refreshed(self, presenter: Presenter, account: RefreshAccount) -> None:
        machine = presenter.machine
        if account.presented:
            self._notifier.ready()
        self._notifier.status(f"{machine.name} ({machine.reason})")
        self._notifier.refreshed(machine.state, machine.missing, presented=account.presented)
        if self._server is not None:
            self._server.publish(lambda: snapshot(self.run, presenter, account) | self._news())
        if self._metrics is not None:
            stats = presenter.stats
            self._metrics.refresh(account, faults=stats.faults, missed_blanks=stats.missed_blanks)

    def abandon_change(self) -> None:
        """The run is over: what is being loaded is no longer wanted."""
        if self._change is not None:
            self._change.abandon()
            self._change = None

    def watches(self, run: Run) -> None:
        self.run = run
        self._configured = run.presenter.run_cell.state.settings

    def wait_for_panel(self, why: str) -> bool:
        """Under a supervisor wait for it, by hand refuse."""
        if not self._notifier.supervised or self._signals.stop:
            return False
        log.warning("waiting for a panel: %s", why)
        self.starting(f"waiting for a panel: {why}")
        time.sleep(PANEL_RETRY_S)
        return not self._signals.stop

    def starting(self, doing: str) -> bool:
        """Asks for more time; before the first refresh there is no account yet, but a reason."""
        self._notifier.extend_start(START_EXTENSION_S)
        self._notifier.status(f"starting ({doing})")
        if self._server is not None:
            self._server.publish(lambda: {"state": str(State.STARTING), "reason": doing})
        return not self._signals.stop

    def _news(self) -> dict[str, Any]:
        """What is being loaded, why the last change was refused, and the black box; for the status."""
        change, news = self._change, {}
        if change is not None:
            news["loading"] = change.progress
        if self._refused:
            news["refused"] = self._refused
        return news | ({"blackbox": self._recorder.describe()} if self._recorder is not None else {})

    def _carry_out(self, presenter: Presenter, command: Command) -> None:
        match command.name:
            case "pause":
                presenter.paused = True
                command.done(**_holds(presenter))
            case "flat":
                presenter.flat_asked = True
                command.done(**_holds(presenter))
            case "resume":
                presenter.paused = presenter.flat_asked = False
                command.done(**_holds(presenter))
            case "reload":
                self._reload(presenter, command)
            case "scene":
                self._show(presenter, command.value, command)
            case "playlist":
                self._show(presenter, str(_written_playlist(command.value)), command)
            case "place":
                self._place(presenter, command)
            case "next":
                self._skip(presenter, command)
            case "model":
                self._begin(presenter, self._configured, self._chosen | {("model", "name"): command.value}, command)
            case "blackbox":
                self._write_black_box(command)

    def _show(self, presenter: Presenter, scene: str, command: Command) -> None:
        # Another scene stands as the configuration has it, not as the one before it was moved.
        chosen = {key: value for key, value in self._chosen.items() if key[1] not in PLACING}
        self._begin(presenter, self._configured, chosen | {("content", "scene"): scene}, command, reload_content=True)

    def _place(self, presenter: Presenter, command: Command) -> None:
        """Move the scene: settings and content change together, once the solver has seen that something is visible."""
        values = command.value or _placing_in(self._configured)
        changed(presenter.run_cell.state.settings, "content", values, source="place")

        def place(parts: Any) -> bool:
            state, now_ns = parts.run.state, presenter.clock.now_ns()
            settings = changed(state.settings, "content", values, source="place")
            try:
                source = placed_source(state.content, placing_of(settings.content), presenter.stack, time_ns=now_ns)
            except PhasestackError as error:
                self._answer(presenter, command, str(error))
            else:
                parts.run.replace(settings=settings, content=source)
                self._chosen = self._chosen | {("content", key): value for key, value in values.items()}
                self._answer(presenter, command, "")
            return True

        presenter.solver.do(place)

    def _skip(self, presenter: Presenter, command: Command) -> None:
        def skip(parts: Any) -> bool:
            done = parts.run.state.content.skip(time_ns=presenter.clock.now_ns())
            problem = "" if done else "there is no next one: what is shown is no playlist, or its last"
            self._answer(presenter, command, problem)
            return True

        presenter.solver.do(skip)

    def _write_black_box(self, command: Command) -> None:
        """What the black box keeps, to a file; the answer comes once it is there."""
        if self._recorder is None:
            command.refuse("this run has no black box")
            return

        def saved(problem: str, path: Path | None) -> None:
            if problem:
                command.refuse(problem)
            else:
                command.done(file=str(path))

        self._recorder.save(ASKED, saved)

    def _reload(self, presenter: Presenter, command: Command | None) -> None:
        """Read the configuration again. What an operator chose stays, but where the file says something new."""
        settings, before = self._read_settings(), self._configured
        frozen = [name for name in NEEDS_RESTART if getattr(settings, name) != getattr(before, name)]
        if frozen:
            raise InputError("reload", ", ".join(frozen), "a change needs a restart of the service")
        chosen = {key: value for key, value in self._chosen.items() if _value(settings, key) == _value(before, key)}
        self._begin(presenter, settings, chosen, command)

    def _begin(
        self,
        presenter: Presenter,
        configured: Settings,
        chosen: Chosen,
        command: Command | None,
        *,
        reload_content: bool = False,
    ) -> None:
        """Load what other settings, and what an operator chose over them, change. A change under way is skipped."""
        settings, present = _with(configured, chosen), presenter.run_cell.state.settings
        change = Reconfiguration(settings, present, presenter.stack, reload_content=reload_content)
        if self._change is not None:
            self._change.abandon()
            self._answer(presenter, self._asked_by, "skipped: a newer change came")
        self._change, self._asked_by, self._pending = change, command, (configured, chosen)
        presenter.solver.do(change.advance)

    def _answer(self, presenter: Presenter, command: Command | None, problem: str) -> None:
        """What became of a change: to who asked for it, to the log and to the status."""
        self._refused = problem
        if problem:
            log.error("refused, what was there stays: %s", problem)
        if command is None:
            self._notifier.reloaded()
        elif problem:
            command.refuse(problem)
        else:
            command.done(**_holds(presenter))


def _with(settings: Settings, chosen: Chosen) -> Settings:
    """The settings with what an operator chose in force. Raises InputError."""
    for (section, key), value in chosen.items():
        settings = changed(settings, section, {key: value}, source="ctl")
    return settings


def _value(settings: Settings, key: tuple[str, str]) -> Any:
    return getattr(getattr(settings, key[0]), key[1])


def _placing_in(settings: Settings) -> dict[str, Any]:
    """What `place` may change, as it is in the settings."""
    return settings.content.model_dump(include=set(PLACING))


def _holds(presenter: Presenter) -> dict[str, Any]:
    """What an operator chooses, as it is now: the answer to every command."""
    state = presenter.run_cell.state
    return {
        "scene": state.settings.content.scene,
        "content": state.content.info.name,
        "model": state.predictor.name,
        "placing": _placing_in(state.settings),
        "paused": presenter.paused,
        "flat_asked": presenter.flat_asked,
    }


def _written_playlist(shows: list[dict[str, Any]]) -> Path:
    """The operator's list as a file, which `content.scene` can name for good. Raises InputError."""
    text = "# Shown from the page or by a program; made anew each time.\n"
    for show in shows:
        scene = json.dumps(scene_from_here(show["scene"]), ensure_ascii=False)  # a TOML string too
        text += f"\n[[show]]\nscene = {scene}\nseconds = {show['seconds']!r}\n"
    path = state_folder() / "playlist.toml"
    write_text(path, text)
    return path


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
        "panels": presenter.panels.name,
        "eyes_m": account.eyes_m,
        "eyes_label": account.eyes_label,
        "eye_sigma_now_mm": account.eye_sigma_mm,
        "solution": account.solution,
        # What was solved for an instant after this light has no age yet.
        "solution_age_now_ms": None if account.solution_age_ms is None else max(0.0, account.solution_age_ms),
        "photon_now_ms": (account.photon_ns - account.capture_ns) / NS_PER_MS if account.capture_ns else None,
        "rejected_samples": {
            **presenter.viewer.refused,
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
        "scenes": (*scene_names(), *library_scenes(settings.content)),
    }


def pictures(run: Run | None) -> dict[str, Any]:
    """What is shown now, as JPEGs in base64: for the page."""
    refresh = run.presenter.last if run is not None else None
    if run is None or refresh is None:
        return {"frame": None, "jpegs": {}}
    try:
        jpegs = pictures_of(refresh, run.presenter.stack)
    except ContextLost:  # its layers were in textures: the next refresh has others
        jpegs = {}
    return {"frame": refresh.account.frame, "jpegs": {name: b64encode(jpeg).decode() for name, jpeg in jpegs.items()}}


@contextmanager
def _recorder(service: ServiceSettings) -> Iterator[Recorder]:
    """The run's black box. Where the run ends with an error, it is written."""
    recorder = Recorder(black_box_folder(service.blackbox_folder), minutes=service.blackbox_minutes)
    try:
        yield recorder
    except (Stopped, InputError):  # the latter before anything ran
        raise
    except Exception as error:
        recorder.close(crashed=one_line(f"{type(error).__name__}: {error}"))
        raise
    finally:
        recorder.close()


def run_daemon(read_settings: Callable[[], Settings], options: RunOptions, *, progress: bool) -> dict[str, Any]:
    """The whole life of `phasestack run`; answers the summary.

    Raises FatalError where the configuration or a file is wrong, TransientError where starting again may help.
    """
    try:
        return _run_supervised(read_settings, options, progress=progress)
    except Exception as error:
        if isinstance(error, TransientError) or not is_retryable(error):
            raise
        raise RetryableError(f"{str(error) or type(error).__name__} (this may pass: start again)") from error


def _run_supervised(read_settings: Callable[[], Settings], options: RunOptions, *, progress: bool) -> dict[str, Any]:
    settings = read_settings()
    check_recording(settings, source="run")  # before seconds go into content and models
    service, clock = settings.service, MonotonicClock()
    logs.configure(service)
    with ExitStack() as cleanup:
        signals = cleanup.enter_context(Signals())
        notifier = Notifier(clock)
        cleanup.callback(notifier.close)
        server = recorder = None
        if not options.max_speed:
            server = open_status_server(service, clock=clock, supervised=notifier.supervised)
            recorder = cleanup.enter_context(_recorder(service))
        metrics = _metrics(service.metrics_port, cleanup)
        daemon = Daemon(
            read_settings, signals=signals, notifier=notifier, server=server, metrics=metrics, recorder=recorder
        )
        if server is not None:
            cleanup.callback(server.close)
            server.lookups["about"] = lambda: about(daemon.run)
            if recorder is not None:
                server.lookups |= {"pictures": lambda: pictures(daemon.run), "log": recorder.look_at_log}
        try:
            summary = drive(settings, options, host=daemon, recorder=recorder, progress=progress, total=options.frames)
        except Stopped as reason:
            summary = {"stopped": str(reason)}
        except PanelLost:
            if not signals.stop:
                raise
            summary = {"stopped": daemon.stop_reason()}  # told so while it waited for a panel
        daemon.abandon_change()
        notifier.stopping(summary["stopped"])
    log.info("stopped: %s", summary["stopped"])
    return summary


def _metrics(port: int, cleanup: ExitStack) -> Metrics | None:
    """None where they are off, or can't be served: the display does not go dark for its figures."""
    if not port:
        return None
    metrics = Metrics()
    try:
        metrics.serve(port)
    except InputError as error:
        log.error("no metrics: %s", error)
        return None
    cleanup.callback(metrics.close)
    return metrics
