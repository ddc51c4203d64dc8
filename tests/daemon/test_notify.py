"""Tests messages to systemd on a real datagram socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from runtime.clock import NS_PER_MS, Clock, SimulatedClock
from runtime.daemon.notify import SETTLED_AFTER, Notifier
from runtime.records import State


class Supervisor:
    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)

    def heard(self) -> list[str]:
        messages = []
        while True:
            try:
                messages.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return messages

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def supervisor(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervisor]:
    name = f"{tmp_path}/notify"
    made = Supervisor(name if request.param == "path" else "\0" + name)
    monkeypatch.setenv("NOTIFY_SOCKET", name if request.param == "path" else "@" + name)
    yield made
    made.close()


@pytest.fixture
def notifier_of() -> Iterator[Callable[..., Notifier]]:
    """Makes notifiers and releases their sockets."""
    made: list[Notifier] = []

    def make(clock: Clock | None = None, environment: Mapping[str, str] | None = None) -> Notifier:
        made.append(Notifier(clock or SimulatedClock(), environment or {}))
        return made[-1]

    yield make
    for notifier in made:
        notifier.close()


Makes = Callable[..., Notifier]
WATCHED = {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": str(os.getpid())}


def test_ready_is_said_once_and_by_no_reload_before_it(supervisor: Supervisor, notifier_of: Makes) -> None:
    notifier = notifier_of()
    assert notifier.supervised
    notifier.reloading()
    notifier.reloaded()
    assert supervisor.heard() == []
    notifier.ready()
    notifier.ready()
    assert supervisor.heard() == ["READY=1"]


def test_the_start_can_be_extended_until_it_is_over(supervisor: Supervisor, notifier_of: Makes) -> None:
    notifier = notifier_of(environment=WATCHED)
    notifier.starting()
    notifier.ready()
    assert supervisor.heard() == ["EXTEND_TIMEOUT_USEC=60000000", "READY=1", "WATCHDOG_USEC=60000000\nWATCHDOG=1"]


def test_the_watchdog_is_patient_until_refreshes_come_steadily(supervisor: Supervisor, notifier_of: Makes) -> None:
    notifier = notifier_of(environment=WATCHED)
    notifier.ready()
    for count in (1, SETTLED_AFTER - 2, 1):
        for _ in range(count):
            notifier.refreshed(State.TRACKING, (), presented=True)
        notifier.status(f"{count} more")
    assert supervisor.heard() == [
        "READY=1", "WATCHDOG_USEC=60000000\nWATCHDOG=1", "WATCHDOG=1", "STATUS=1 more",
        f"STATUS={SETTLED_AFTER - 2} more", "WATCHDOG_USEC=1000000", "STATUS=1 more",
    ]  # fmt: skip


def test_presented_frames_feed_the_watchdog_four_times_a_period_at_most(
    supervisor: Supervisor, notifier_of: Makes
) -> None:
    clock = SimulatedClock()
    notifier = notifier_of(clock, WATCHED)
    for _ in range(100):  # a second of 100 frames/s
        notifier.refreshed(State.TRACKING, (), presented=True)
        clock.advance_ns(10 * NS_PER_MS)
    assert supervisor.heard() == ["WATCHDOG=1"] * 4


def test_refreshes_that_present_nothing_starve_the_watchdog_unless_a_panel_is_missing(
    supervisor: Supervisor, notifier_of: Makes
) -> None:
    clock = SimulatedClock()
    notifier = notifier_of(clock, WATCHED)
    for state, missing in ((State.TRACKING, ()), (State.DEGRADED, ("sensor",)), (State.STARTING, ("panel",))):
        clock.advance_ns(2000 * NS_PER_MS)
        notifier.refreshed(state, missing, presented=False)
    assert supervisor.heard() == []
    notifier.refreshed(State.DEGRADED, ("sensor", "panel"), presented=False)
    assert supervisor.heard() == ["WATCHDOG=1"]


@pytest.mark.parametrize("environment", [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "9", "WATCHDOG_PID": "1"}])
def test_a_watchdog_that_is_not_ours_is_not_fed(
    supervisor: Supervisor, notifier_of: Makes, environment: dict[str, str]
) -> None:
    notifier_of(environment=environment).refreshed(State.TRACKING, (), presented=True)
    assert supervisor.heard() == []


def test_a_supervisor_that_does_not_listen_blocks_nobody(supervisor: Supervisor, notifier_of: Makes) -> None:
    clock = SimulatedClock()
    notifier = notifier_of(clock, WATCHED)
    for _ in range(5000):  # far more than a datagram socket holds
        clock.advance_ns(1000 * NS_PER_MS)
        notifier.refreshed(State.TRACKING, (), presented=True)
    heard = supervisor.heard()
    assert 0 < len(heard) < 5000  # messages that did not fit were dropped without waiting
    assert set(heard) == {"WATCHDOG=1"}
    notifier.close()
    notifier.close()
