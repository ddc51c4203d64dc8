"""Supervise a run: handle signals, systemd, the status socket and operator commands."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from runtime.blackbox.recorder import ASKED, Recorder
from runtime.clock import MonotonicClock
from runtime.config import Settings
from runtime.daemon import status as answers
from runtime.daemon.build import Host, Run, RunOptions
from runtime.daemon.changes import Changes
from runtime.daemon.commands import Command
from runtime.daemon.drive import drive
from runtime.daemon.notify import Notifier
from runtime.daemon.server import StatusServer, open_status_server
from runtime.daemon.signals import Signals
from runtime.errors import FatalError, PanelLost, Stopped, retry_advised
from runtime.frame.presenter import Presenter
from runtime.frame.refresh import Status
from runtime.records import State
from runtime.support import logs
from runtime.support.folders import state_folder
from runtime.support.memory import keep_freed_memory

log = logging.getLogger("phasestack.daemon")

PANEL_RETRY_S = 1.0  # interval between attempts to find a missing panel


class Daemon(Host):
    """Handles signals and commands, and publishes the status, between refreshes. All methods must be
    called on the presenter's thread. The status server's thread calls only the latest published snapshot and the
    functions in the server's `lookups`, and these read only a frozen `Status` and thread-safe counters.
    """

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
        """Create a supervisor for one run; `read_settings`, on the loading thread, may raise InputError."""
        self._until = (options or RunOptions()).until
        self._link = (options or RunOptions()).browser
        self._read_settings = read_settings
        self._signals, self._notifier, self._server = signals, notifier, server
        self.recorder = recorder
        self.run: Run | None = None  # set, like `changes`, once the run has been built
        self.changes: Changes | None = None
        self._waits_for = ""  # why the daemon is waiting for a panel before the first refresh

    def stop_reason(self) -> str:
        return f"{self._signals.stop} received" if self._signals.stop else self._until()

    def carry_out_commands(self, presenter: Presenter) -> None:
        changes = self.changes
        assert changes is not None
        if self._signals.take_reload():
            self._notifier.reloading()
            command = Command("reload")
            command.answer.add_done_callback(lambda _: self._notifier.reloaded())
            changes.attempt(command, partial(self._carry_out, presenter, changes, command))
        while self._server is not None and not self._server.commands.empty():
            command = self._server.commands.get()
            if command.take():  # if not, the client has given up
                changes.attempt(command, partial(self._carry_out, presenter, changes, command))
        changes.carry_on()

    def refreshed(self, status: Status) -> None:
        account, run, changes = status.refresh.account, self.run, self.changes
        assert run is not None and changes is not None
        if account.presented:
            self._notifier.ready()
        self._notifier.status(f"{status.name} ({status.reason})")
        self._notifier.refreshed(account.state, status.missing, presented=account.presented)
        if self._server is not None:
            loading, refused, recorder = changes.loading, changes.refused, self.recorder
            self._server.publish(lambda: answers.snapshot(status, run) | _news(loading, refused, recorder))
        if self._link is not None:
            observer = run.observer
            told = answers.shown(status, light=observer.light(status.refresh), head_of=observer.truth.place_of)
            self._link.show(status.refresh.frame, told, moment=observer.moment)

    def watches(self, run: Run) -> None:
        self.run, self.changes = run, Changes(run.presenter)
        if self._server is not None:
            presenter = run.presenter
            self._server.lookups |= {
                "about": lambda: answers.about(presenter.settings, presenter.stack),
                "pictures": lambda: answers.pictures(presenter.status, presenter.stack),
            }
            self._server.lookups |= {"log": self.recorder.look_at_log} if self.recorder is not None else {}

    def wait_for_panel(self, why: str) -> bool:
        """Report a missing panel, and wait a second. Returns False without systemd or after a stop signal."""
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
        """Report the startup step and ask systemd for more time. Returns False after a stop signal."""
        self._notifier.starting()
        self._notifier.status(f"starting ({doing})")
        if self._server is not None:
            self._server.publish(lambda: {"state": str(State.STARTING), "reason": doing})
        return not self._signals.stop

    def _carry_out(self, presenter: Presenter, changes: Changes, command: Command) -> None:
        match command.name:
            case "pause":
                presenter.paused = True
                command.done(**changes.holds())
            case "flat":
                presenter.flat_asked = True
                command.done(**changes.holds())
            case "resume":
                presenter.paused = presenter.flat_asked = False
                command.done(**changes.holds())
            case "reload":
                read = self._read_settings
                changes.begin(command, lambda choices: choices.reloaded(read))
            case "scene":
                changes.begin(command, lambda choices: choices.another_scene(command.value), reload_content=True)
            case "model":
                changes.begin(command, lambda choices: choices.choosing("model", name=command.value))
            case "place":
                changes.place(command)
            case "next":
                changes.skip(command)
            case "blackbox":
                self._write_black_box(command)

    def _write_black_box(self, command: Command) -> None:
        """Write the black box to a file. The command is answered by the thread that writes it."""
        if self.recorder is None:
            command.refuse("the black box is switched off; set service.blackbox_minutes above 0")
            return

        def saved(problem: str, path: Path | None) -> None:
            if problem:
                command.refuse(problem)
            else:
                command.done(file=str(path))

        self.recorder.save(ASKED, saved)


def _news(loading: str | None, refused: str, recorder: Recorder | None) -> dict[str, Any]:
    """Return the status entries about the change being loaded, the last refusal and the black box."""
    news: dict[str, Any] = {} if loading is None else {"loading": loading}
    if refused:
        news["refused"] = refused
    return news | ({"blackbox": recorder.describe()} if recorder is not None else {})


@retry_advised()
def run_daemon(read_settings: Callable[[], Settings], options: RunOptions) -> dict[str, Any]:
    """Run the daemon until it stops, and return its summary. Raises FatalError or TransientError.
    `read_settings` is called at startup and on each reload.
    """
    keep_freed_memory()  # before any thread is started
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
            read_settings, signals=signals, notifier=notifier, server=server, recorder=recorder, options=options
        )
        try:
            summary = drive(settings, options, daemon)
        except Stopped as reason:
            summary = {"stopped": str(reason)}
        except SystemExit as error:
            raise FatalError(f"a class named in the configuration called sys.exit({error.code!r})") from error
        except PanelLost:
            if not signals.stop:
                raise
            summary = {"stopped": daemon.stop_reason()}  # it was stopped while waiting for a panel
        notifier.stopping(summary["stopped"])
    log.info("stopped: %s", summary["stopped"])
    return summary
