"""The supervised run: signals, systemd, the status socket, reload. Imported when `run` starts."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from runtime.blackbox.recorder import ASKED, Recorder
from runtime.clock import MonotonicClock
from runtime.config import Settings, changed
from runtime.content.placed import placed_source, placing_of
from runtime.daemon import status
from runtime.daemon.build import Host, Run, RunOptions
from runtime.daemon.commands import PLACING, Command
from runtime.daemon.drive import drive
from runtime.daemon.notify import Notifier
from runtime.daemon.reconfigure import Reconfiguration, moved_since
from runtime.daemon.server import StatusServer, open_status_server
from runtime.daemon.signals import Signals
from runtime.errors import FatalError, InputError, PanelLost, PhasestackError, Stopped, retry_advised
from runtime.frame.presenter import Presenter
from runtime.records import RefreshAccount, State
from runtime.support import logs
from runtime.support.folders import state_folder
from runtime.support.memory import keep_freed_memory

log = logging.getLogger("phasestack.daemon")

PANEL_RETRY_S = 1.0  # between two looks for a panel that is missing at the start
NEEDS_RESTART = ("stack", "sensor", "output", "service", "model.backend")
Chosen = dict[tuple[str, str], Any]  # section and key of a setting: what an operator chose while it runs


@dataclass(slots=True)
class _Change:
    """What is to be loaded for a command, and what holds once it is taken over."""

    command: Command
    read: Callable[[], tuple[Settings, Chosen]]  # the configuration, and what is chosen over it
    reload_content: bool = False
    configured: Settings = field(default_factory=Settings)
    chosen: Chosen = field(default_factory=dict)

    def settings(self) -> Settings:
        """That are to hold; on the loading thread. Raises InputError."""
        self.configured, self.chosen = self.read()
        settings = self.configured
        for (section, key), value in self.chosen.items():
            settings = changed(settings, section, {key: value}, source="ctl")
        return settings


class Daemon(Host):
    """The run's supervisor: carries what operators ask in and news out, once a refresh."""

    def __init__(
        self,
        read_settings: Callable[[], Settings],
        *,
        signals: Signals,
        notifier: Notifier,
        server: StatusServer | None = None,
        recorder: Recorder | None = None,
        options: RunOptions | None = None,
    ) -> None:
        """read_settings: the configuration as it is now; raises InputError."""
        self._until = (options or RunOptions()).until
        self._link = (options or RunOptions()).browser
        self._read_settings = read_settings
        self._signals, self._notifier, self._server = signals, notifier, server
        self.recorder = recorder
        self.run: Run | None = None  # set when it has been put together
        self._configured = Settings()  # as last read
        self._chosen: Chosen = {}  # by an operator, in force over the configuration
        self._change: tuple[_Change, Reconfiguration] | None = None  # under way
        self._next: _Change | None = None  # begins once that is over
        self._waits_for = ""  # before the first refresh: which panel, and why
        self._refused = ""  # why the last change was refused, until one is taken

    def stop_reason(self) -> str:
        return f"{self._signals.stop} received" if self._signals.stop else self._until()

    def carry_out_commands(self, presenter: Presenter) -> None:
        if self._signals.take_reload():
            self._notifier.reloading()
            command = Command("reload")
            command.answer.add_done_callback(lambda _: self._notifier.reloaded())
            self._attempt(presenter, command, partial(self._carry_out, presenter, command))
        while self._server is not None and not self._server.commands.empty():
            command = self._server.commands.get()
            if command.take():  # else it was refused meanwhile: never done later
                self._attempt(presenter, command, partial(self._carry_out, presenter, command))
        if self._change is not None and self._change[1].finished:
            (change, loading), self._change = self._change, None
            if not loading.abandoned:
                self._changed(presenter, change, loading)
        if self._change is None and self._next is not None:
            change, self._next = self._next, None
            self._attempt(presenter, change.command, partial(self._load, presenter, change))

    def _changed(self, presenter: Presenter, change: _Change, loading: Reconfiguration) -> None:
        """It has been taken over, or refused."""
        if not loading.problem:
            state = presenter.run_cell.state
            moved = moved_since(loading.settings.content, state.settings.content)  # while it was loading
            self._configured = change.configured
            self._chosen = change.chosen | {("content", key): value for key, value in moved.items()}
            log.info("changed: scene %s, model %s", state.content.info.name, state.predictor.name)
        self._answer(presenter, change.command, loading.problem)

    def _attempt(self, presenter: Presenter, command: Command, work: Callable[[], None]) -> None:
        """What is asked for; whatever goes wrong with one request does not end what everybody looks at."""
        try:
            work()
        except PhasestackError as error:
            self._answer(presenter, command, str(error))
        except (Exception, SystemExit) as error:
            log.exception("%s", command.name)
            self._answer(presenter, command, f"unexpected error ({type(error).__name__}): see the log")

    def refreshed(self, presenter: Presenter, account: RefreshAccount) -> None:
        machine = presenter.machine
        if account.presented:
            self._notifier.ready()
        self._notifier.status(f"{machine.name} ({machine.reason})")
        self._notifier.refreshed(machine.state, machine.missing, presented=account.presented)
        if self._server is not None and (run := self.run) is not None:
            self._server.publish(lambda: status.snapshot(run, account) | self._news())
        if self._link is not None:
            self._link.moment = self.run.observer.moment if self.run is not None else None
            self._link.refreshed(status.shown(presenter, account, self._link))

    def watches(self, run: Run) -> None:
        self.run = run
        self._configured = run.presenter.run_cell.state.settings
        if self._server is not None:
            self._server.lookups |= {"about": lambda: status.about(run), "pictures": lambda: status.pictures(run)}
            self._server.lookups |= {"log": self.recorder.look_at_log} if self.recorder is not None else {}

    def wait_for_panel(self, why: str) -> bool:
        """As a service, report that a panel is missing and retry; by hand, refuse."""
        if not self._notifier.supervised or self._signals.stop:
            return False
        if why != self._waits_for:
            self._waits_for = why
            log.warning("waiting for a panel: %s", why)
        self.starting(f"waiting for a panel: {why}")
        self._notifier.ready()
        again_s = time.monotonic() + PANEL_RETRY_S
        while not self._signals.stop and time.monotonic() < again_s:
            time.sleep(0.05)
        return not self._signals.stop

    def starting(self, doing: str) -> bool:
        """Asks for more time; before the first refresh there is no account yet, but a reason."""
        self._notifier.starting()
        self._notifier.status(f"starting ({doing})")
        if self._server is not None:
            self._server.publish(lambda: {"state": str(State.STARTING), "reason": doing})
        return not self._signals.stop

    def _news(self) -> dict[str, Any]:
        """What is being loaded, why the last change was refused, and the black box; for the status."""
        change, news = self._change, {}
        if change is not None:
            news["loading"] = change[1].progress
        if self._refused:
            news["refused"] = self._refused
        return news | ({"blackbox": self.recorder.describe()} if self.recorder is not None else {})

    def _carry_out(self, presenter: Presenter, command: Command) -> None:
        match command.name:
            case "pause":
                presenter.paused = True
                command.done(**status.holds(presenter))
            case "flat":
                presenter.flat_asked = True
                command.done(**status.holds(presenter))
            case "resume":
                presenter.paused = presenter.flat_asked = False
                command.done(**status.holds(presenter))
            case "reload":
                self._begin(presenter, _Change(command, self._reloaded))
            case "scene":
                self._show(presenter, command.value, command)
            case "place":
                self._place(presenter, command)
            case "next":
                self._skip(presenter, command)
            case "model":
                model: Chosen = {("model", "name"): command.value}
                self._begin(presenter, _Change(command, lambda: (self._configured, self._chosen | model)))
            case "blackbox":
                self._write_black_box(command)

    def _show(self, presenter: Presenter, scene: str, command: Command) -> None:
        # Another scene stands as the configuration has it, not as the one before it was moved.
        def read() -> tuple[Settings, Chosen]:
            chosen = {key: value for key, value in self._chosen.items() if key[1] not in PLACING}
            return self._configured, chosen | {("content", "scene"): scene}

        self._begin(presenter, _Change(command, read, reload_content=True))

    def _place(self, presenter: Presenter, command: Command) -> None:
        """Move the scene: settings and content change together, on the solver's thread."""
        values = command.value or status.placing_in(self._configured)
        changed(presenter.run_cell.state.settings, "content", values, source="place")

        def place(parts: Any) -> str:
            state = parts.run.state
            settings = changed(state.settings, "content", values, source="place")
            source = placed_source(state.content, placing_of(settings.content))
            parts.replace(settings=settings, content=source)
            self._chosen = self._chosen | {("content", key): value for key, value in values.items()}
            return ""

        self._between_steps(presenter, command, place)

    def _skip(self, presenter: Presenter, command: Command) -> None:
        def skip(parts: Any) -> str:
            done = parts.run.state.content.skip(time_ns=presenter.clock.now_ns())
            return "" if done else "there is no next one: what is shown is no playlist, or its last"

        self._between_steps(presenter, command, skip)

    def _between_steps(self, presenter: Presenter, command: Command, work: Callable[[Any], str]) -> None:
        """Have it done on the solver's thread, which answers; work: why it was refused, empty: it was done."""

        def task(parts: Any) -> bool:
            self._attempt(presenter, command, lambda: self._answer(presenter, command, work(parts)))
            return True

        presenter.solver.do(task)

    def _write_black_box(self, command: Command) -> None:
        """What the black box keeps, to a file; the answer comes once it is there."""
        if self.recorder is None:
            command.refuse("this run has no black box")
            return

        def saved(problem: str, path: Path | None) -> None:
            if problem:
                command.refuse(problem)
            else:
                command.done(file=str(path))

        self.recorder.save(ASKED, saved)

    def _reloaded(self) -> tuple[Settings, Chosen]:
        """The configuration read again. What an operator chose stays, but where the file says something new."""
        settings, before = self._read_settings(), self._configured
        frozen = [name for name in NEEDS_RESTART if attrgetter(name)(settings) != attrgetter(name)(before)]
        if frozen:
            raise InputError("reload", ", ".join(frozen), "a change needs a restart of the service")
        return settings, {
            (section, key): value
            for (section, key), value in self._chosen.items()
            if getattr(getattr(settings, section), key) == getattr(getattr(before, section), key)
        }

    def _begin(self, presenter: Presenter, change: _Change) -> None:
        """One load at a time: what is under way is given up, and the newest waits for its end."""
        if self._change is None:
            self._load(presenter, change)
            return
        (now, loading), before = self._change, self._next
        for skipped in (None if loading.abandoned else now, before):
            if skipped is not None:
                self._answer(presenter, skipped.command, "skipped: a newer change came")
        loading.abandon()
        self._next = change

    def _load(self, presenter: Presenter, change: _Change) -> None:
        """Load what other settings, and what an operator chose over them, change."""
        present = presenter.run_cell.state.settings
        loading = Reconfiguration(change.settings, present, presenter.stack, reload_content=change.reload_content)
        self._change = change, loading
        presenter.solver.do(loading.advance)

    def _answer(self, presenter: Presenter, command: Command, problem: str) -> None:
        """What became of a change: to who asked for it, to the log and to the status."""
        self._refused = problem
        if problem:
            log.error("refused, what was there stays: %s", problem)
            command.refuse(problem)
        else:
            command.done(**status.holds(presenter))


@retry_advised()
def run_daemon(read_settings: Callable[[], Settings], options: RunOptions) -> dict[str, Any]:
    """The whole life of `phasestack run`; answers the summary.

    Raises FatalError where the configuration or a file is wrong, TransientError where starting again may help.
    """
    keep_freed_memory()  # before GL, the server and whatever else begins threads
    settings = read_settings()
    service, clock = settings.service, MonotonicClock()
    logs.configure()
    with ExitStack() as cleanup:
        signals = cleanup.enter_context(Signals())
        notifier = Notifier(clock)
        cleanup.callback(notifier.close)
        server = recorder = None
        if not options.max_speed:
            server = open_status_server(service, clock=clock, supervised=notifier.supervised)
            recorder = cleanup.enter_context(Recorder(state_folder() / "blackbox", minutes=service.blackbox_minutes))
        if server is not None:
            cleanup.callback(server.close)
        daemon = Daemon(
            read_settings,
            signals=signals,
            notifier=notifier,
            server=server,
            recorder=recorder,
            options=options,
        )
        try:
            summary = drive(settings, options, daemon)
        except Stopped as reason:
            summary = {"stopped": str(reason)}
        except SystemExit as error:
            raise FatalError(f"a configured class ended the run: sys.exit({error.code!r})") from error
        except PanelLost:
            if not signals.stop:
                raise
            summary = {"stopped": daemon.stop_reason()}  # told so while it waited for a panel
        notifier.stopping(summary["stopped"])
    log.info("stopped: %s", summary["stopped"])
    return summary
