"""Notify systemd (sd_notify and watchdog). Without systemd, all calls do nothing."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from typing import Any

from runtime.clock import Clock
from runtime.records import State

NS_PER_US = 1000
START_STEP_S = 60.0  # no startup step takes longer than this, even on the slowest machine
SETTLED_AFTER = 100  # refreshes with a longer watchdog period, because compiling shaders at first takes seconds


class Notifier:
    """Sends the daemon's status and watchdog messages to systemd. Its methods never block or raise."""

    def __init__(self, clock: Clock, environment: Mapping[str, str] = os.environ) -> None:
        """Connect to systemd, whose variables give the watchdog period, if it runs this process."""
        self._clock = clock
        self._channel: Any = None
        if "NOTIFY_SOCKET" in os.environ:  # without this variable, sdnotify would leave a socket open
            import sdnotify

            self._channel = sdnotify.SystemdNotifier()
        if self._channel is not None and self._channel.socket is not None:
            self._channel.socket.setblocking(False)
        self._watchdog_ns = watchdog_ns(environment)
        self._fed_ns = -self._watchdog_ns
        self._settling = 0  # number of refreshes until the normal watchdog period applies
        self._status = ""
        self._ready = False

    @property
    def supervised(self) -> bool:
        """True under systemd. Startup then waits for missing panels instead of failing."""
        return self._channel is not None and self._channel.socket is not None

    def ready(self) -> None:
        """Report that the first frame is shown or panels are being waited for. Later calls do nothing."""
        if not self._ready:
            self._ready = True
            self._send("READY=1")
            self.starting()

    def status(self, text: str) -> None:
        """Set the line shown by `systemctl status`. If it has not changed, it is not sent again."""
        line = " ".join(text.split())
        if line != self._status:
            self._status = line
            self._send(f"STATUS={line}")

    def starting(self) -> None:
        """Report progress during startup, which extends the startup or watchdog timeout."""
        step_us = round(START_STEP_S * 1e6)
        if not self._ready:
            self._send(f"EXTEND_TIMEOUT_USEC={step_us}")
        elif self._watchdog_ns:
            self._settling = SETTLED_AFTER
            self._send(f"WATCHDOG_USEC={step_us}\nWATCHDOG=1")

    def refreshed(self, state: State, missing: Collection[str], *, presented: bool) -> None:
        """Feed the watchdog after a refresh, at most four times per period.

        A refresh counts if the panels showed it or if a panel is missing. It does not matter whether the solver is
        working, because while it fails or restarts, the last solution stays on the panels and is still aligned to the
        eyes. Before READY, the startup timeout applies instead. During the first hundred refreshes, the watchdog period
        is longer.
        """
        alive = presented or (state is State.DEGRADED and "panel" in missing)
        if not (alive and self._watchdog_ns):
            return
        if self._settling:
            self._settling -= 1
            if not self._settling:
                self._send(f"WATCHDOG_USEC={self._watchdog_ns // NS_PER_US}")
        now_ns = self._clock.now_ns()
        if now_ns - self._fed_ns >= self._watchdog_ns // 4:
            self._fed_ns = now_ns
            self._send("WATCHDOG=1")

    def reloading(self) -> None:
        """Report that the configuration is being reloaded. Before the first READY, this does nothing."""
        if self._ready:
            self._send(f"RELOADING=1\nMONOTONIC_USEC={self._clock.now_ns() // NS_PER_US}")

    def reloaded(self) -> None:
        """Report that reloading is over, whether or not it succeeded."""
        if self._ready:
            self._send("READY=1")

    def stopping(self, reason: str) -> None:
        """Report that the daemon is stopping on purpose."""
        self._send(f"STOPPING=1\nSTATUS=stopping: {' '.join(reason.split())}")

    def close(self) -> None:
        """Close the socket. May be called twice."""
        if self.supervised:
            self._channel.socket.close()
            self._channel.socket = None

    def _send(self, message: str) -> None:
        if self._channel is not None:
            self._channel.notify(message)


def watchdog_ns(environment: Mapping[str, str]) -> int:
    """Return the watchdog period in nanoseconds, or 0 if this process has no watchdog."""
    ours = int(environment.get("WATCHDOG_PID", os.getpid())) == os.getpid()
    return int(environment.get("WATCHDOG_USEC", "0")) * NS_PER_US if ours else 0
