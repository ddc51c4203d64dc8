"""The supervised run: signals, systemd, the status socket, reload. Imported when `run` starts."""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from runtime.clock import MonotonicClock
from runtime.commands.running import drive, print_summary
from runtime.config import Overrides, Settings, load_settings
from runtime.daemon.build import RunOptions
from runtime.daemon.commands import Command
from runtime.daemon.notify import Notifier
from runtime.daemon.reconfigure import Changeover
from runtime.daemon.server import StatusServer, open_status_server
from runtime.daemon.signals import Signals
from runtime.errors import PhasestackError
from runtime.frame.loop import Loop
from runtime.plan.planner import Planner
from runtime.records import FrameAccount
from runtime.support import logs

log = logging.getLogger("phasestack.daemon")

PANEL_RETRY_S = 1.0
START_EXTENSION_S = 10.0
NEEDS_RESTART = ("stack", "sensor", "detector", "output", "service")


class Daemon:
    """The loop's supervisor: carries wishes in and news out, once a turn."""

    def __init__(
        self,
        config: Path | None,
        overrides: Overrides,
        settings: Settings,
        *,
        signals: Signals,
        notifier: Notifier,
        server: StatusServer | None,
        metrics: Any | None,
    ) -> None:
        self._config, self._overrides, self._settings = config, overrides, settings
        self._signals, self._notifier, self._server, self._metrics = signals, notifier, server, metrics
        self._faults_told: dict[str, int] = {}
        self._missed_told = 0
        self._change: Changeover | None = None
        self._asked_by: Command | None = None  # for the change under way; None: a signal
        self._refused = ""  # why the last change was refused, until one is taken

    def stop_reason(self) -> str:
        return f"{self._signals.stop} received" if self._signals.stop else ""

    def obey(self, loop: Loop) -> None:
        if self._signals.take_reload():
            self._notifier.reloading()
            self._reload(loop, None)
        while self._server is not None and not self._server.commands.empty():
            self._carry_out(self._server.commands.get(), loop)
        if self._change is not None and self._change.poll(loop.context):
            change, self._change = self._change, None
            if not change.problem:
                change.commit(loop)
                self._settings = change.settings
                log.info("changed: scene %s, model %s", loop.pipeline.content.info.name, loop.pipeline.predictor.name)
            self._answer(self._asked_by, change.problem)

    def turn(self, loop: Loop, account: FrameAccount) -> None:
        machine = loop.machine
        if account.presented:
            self._notifier.ready()
        self._notifier.status(f"{machine.name} ({machine.reason})")
        self._notifier.turn(machine.state, machine.missing, presented=account.presented)
        if self._server is not None:
            self._server.publish(lambda: snapshot(loop, account) | self._loading())
        if self._metrics is not None:
            self._metrics.frame(account)
            self._metrics.missed_vblanks(loop.stats.missed_vblanks - self._missed_told)
            self._missed_told = loop.stats.missed_vblanks
            self._metrics.fps(loop.stats.recent_fps())
            for part, count in loop.stats.faults.items():
                for _ in range(count - self._faults_told.get(part, 0)):
                    self._metrics.fault(part)
                self._faults_told[part] = count

    def wait_for_panels(self, why: str) -> bool:
        """A panel is not there yet: under a supervisor wait for it, by hand refuse."""
        if not self._notifier.supervised or self._signals.stop:
            return False
        log.warning("waiting for a panel: %s", why)
        self._notifier.extend_start(START_EXTENSION_S)
        self._notifier.status(f"starting (waiting for a panel: {why})")
        time.sleep(PANEL_RETRY_S)
        return not self._signals.stop

    def starting(self, doing: str) -> bool:
        """Something before the first frame takes long: ask for more time. False: told to stop."""
        self._notifier.extend_start(START_EXTENSION_S)
        self._notifier.status(f"starting ({doing})")
        return not self._signals.stop

    def _loading(self) -> dict[str, str]:
        """What is being loaded, and why the last change was refused; for the status."""
        change, told = self._change, {}
        if change is not None:
            told["loading"] = change.progress
        if self._refused:
            told["refused"] = self._refused
        return told

    def _carry_out(self, command: Command, loop: Loop) -> None:
        match command.name:
            case "pause":
                loop.paused = True
                command.done()
            case "resume":
                loop.paused = loop.flat_wanted = False
                command.done()
            case "flat":
                loop.flat_wanted = True
                command.done()
            case "reload":
                self._reload(loop, command)
            case "scene":
                content = self._settings.content.model_copy(update={"scene": command.value})
                settings = self._settings.model_copy(update={"content": content})
                self._begin(loop, settings, command, reload_content=True)
            case "budget":
                self._set_budget(loop, command.value)
                command.done()

    def _set_budget(self, loop: Loop, budget_ms: float) -> None:
        """In force at once; which level holds it is measured beside the loop, where it isn't known yet."""
        self._settings = _with_budget(self._settings, budget_ms)
        loop.apply(self._settings)
        if self._change is not None:
            self._change.settings = _with_budget(self._change.settings, budget_ms)
        loop.pipeline.plan_with(Planner(loop.settings, loop.pipeline.stack))
        loop.budget.changed(loop.settings, content=False, model=False)

    def _reload(self, loop: Loop, command: Command | None) -> None:
        """Read the configuration again."""
        try:
            settings = self._overrides.applied(load_settings(self._config))
        except PhasestackError as error:
            self._answer(command, str(error))
            return
        changed = [name for name in NEEDS_RESTART if getattr(settings, name) != getattr(self._settings, name)]
        if changed:
            self._answer(command, f"{self._config}: {changed[0]}: a change needs a restart of the service")
        else:
            self._begin(loop, settings, command)

    def _begin(self, loop: Loop, settings: Settings, command: Command | None, *, reload_content: bool = False) -> None:
        """Load what the settings change; what was being loaded is overtaken."""
        if self._change is not None:
            self._change.abandon()
            self._change = None
            self._answer(self._asked_by, "overtaken by a newer change")
        try:
            change = Changeover(settings, self._settings, loop.pipeline.stack, reload_content=reload_content)
        except PhasestackError as error:
            self._answer(command, str(error))
            return
        self._change, self._asked_by = change, command
        if command is not None:
            command.begin()

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


def _with_budget(settings: Settings, budget_ms: float) -> Settings:
    return settings.model_copy(update={"model": settings.model.model_copy(update={"budget_ms": budget_ms})})


def snapshot(loop: Loop, account: FrameAccount) -> dict[str, Any]:
    """What `status` answers."""
    machine, stats = loop.machine, loop.stats
    counted = stats.summary(seconds=loop.seconds(), stale_inputs=loop.source.stale_inputs)
    return {
        "state": machine.name,
        "reason": machine.reason,
        "missing": loop.missing,
        "scene": loop.settings.content.scene,
        "plan": loop.plan_items(),
        "model": loop.pipeline.predictor.name,
        "provider": loop.pipeline.predictor.provider,
        "budget": loop.budget.describe(),
        "panels": loop.panels.name,
        "eyes_m": account.eyes_m,
        "eyes_label": account.eyes_label,
        "skew_ms": account.skew_ms,
        **{key: counted[key] for key in counted if key != "skew_ms"},
    }


def run_daemon(
    config: Path | None,
    overrides: Overrides,
    *,
    frames: int | None,
    max_speed: bool,
    out: Path | None,
    scale: float,
    quiet: bool,
) -> dict[str, Any]:
    """The whole life of `phasestack run`; answers the summary. Raises FatalError."""
    settings = overrides.applied(load_settings(config))
    logs.configure(settings.service)
    clock = MonotonicClock()
    with ExitStack() as cleanup:
        signals = cleanup.enter_context(Signals())
        notifier = Notifier(clock)
        cleanup.callback(notifier.close)
        server = (
            None if max_speed else open_status_server(settings.service, clock=clock, supervised=notifier.supervised)
        )
        if server is not None:
            cleanup.callback(server.close)
        metrics = None
        if settings.service.metrics_port:
            from runtime.daemon.metrics import Metrics

            metrics = Metrics()
            metrics.serve(settings.service.metrics_port)
            cleanup.callback(metrics.close)
        daemon = Daemon(config, overrides, settings, signals=signals, notifier=notifier, server=server, metrics=metrics)
        summary = drive(
            settings,
            RunOptions(max_speed=max_speed, measure=out is not None, scale=scale),
            out=out,
            frames=frames,
            total=frames,
            progress=max_speed and not quiet,
            measured_times=not max_speed,
            supervisor=daemon,
            wait_for_panels=daemon.wait_for_panels,
            on_start=daemon.starting,
        )
        notifier.stopping(summary["stopped"])
    log.info("stopped: %s", summary["stopped"])
    if not quiet and not notifier.supervised:
        print_summary(summary, out)
    return summary
