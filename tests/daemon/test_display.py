"""Tests the daemon on three virtual monitors, with a monitor that disappears and an X server that dies."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.daemon.client import ask
from tests.daemon.test_daemon import CONFIG as daemon_config
from tests.daemon.test_daemon import Daemon
from tests.panels import xserver
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX, XServer
from tests.waiting import eventually

pytestmark = pytest.mark.windows

SMALL = daemon_config.replace("192", str(WIDTH_PX)).replace("108", str(HEIGHT_PX)).replace("60.0", "30.0")
PANELS = "".join(f'[[output.panels]]\nconnector = "DUMMY{index}"\n' for index in range(3))
CONFIG = SMALL + '[output]\nkind = "windows"\n' + PANELS


@pytest.fixture
def x(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    servers = [xserver.start_or_skip(tmp_path)]
    monkeypatch.setenv("DISPLAY", servers[0].name)
    yield servers
    servers[-1].stop()


@pytest.fixture
def daemon(x: Any, tmp_path: Path) -> Any:
    started = Daemon(tmp_path, config=CONFIG, headless=False, watchdog_s=2.0)
    assert started.hears("READY=1")
    yield started
    started.close()


def state(daemon: Daemon) -> str:
    return daemon.status()["state"]


def shows_something_on(x: list[xserver.XServer]) -> bool:
    return all(int(np.ptp(x[-1].panel(index))) > 0 for index in range(3))


def test_it_shows_scenes_survives_a_lost_monitor_and_stops_in_order(daemon: Any, x: XServer) -> None:
    assert eventually(lambda: shows_something_on(x))
    status = daemon.status()
    assert (status["panels"], status["scene"]) == ("windows", "demo")
    assert status["skew_ms"]["p50"] >= 0
    demo = x[0].panel(1)
    for scene in ("texture", "demo", "texture"):  # drawn in the content's context, with any windows
        assert ask([daemon.socket], {"command": "scene", "value": scene})["ok"]
    assert eventually(lambda: daemon.status()["scene"] == "texture")
    assert eventually(lambda: bool(np.mean(x[0].panel(1).astype(float) != demo) > 0.5))
    assert state(daemon) in ("tracking", "holding", "flat")
    x[0].unplug(1)
    assert eventually(lambda: state(daemon) == "degraded: panel")
    assert "DUMMY1" in daemon.status()["reason"]
    daemon.heard.clear()
    assert daemon.hears("WATCHDOG=1")  # by completed turns: nothing can be presented
    dropped = daemon.status()["dropped"]
    assert eventually(lambda: daemon.status()["dropped"] > dropped)
    x[0].plug(1)
    assert eventually(lambda: state(daemon) in ("tracking", "holding", "flat"))
    assert eventually(lambda: shows_something_on(x))
    daemon.process.send_signal(signal.SIGTERM)
    code, errors = daemon.ends()
    assert code == 0, errors


def test_after_the_x_server_dies_a_restarted_daemon_waits_for_it(daemon: Any, x: XServer, tmp_path: Path) -> None:
    x[0].stop()
    code, errors = daemon.ends()
    assert code == 75
    assert "the X server died" in errors
    again = tmp_path / "again"
    again.mkdir()
    second = Daemon(again, config=CONFIG, headless=False, watchdog_s=2.0)  # as systemd does
    try:
        assert second.hears("READY=1")  # waiting counts as ready: nothing blocks on the daemon
        assert second.hears("WATCHDOG=1")
        assert second.status()["state"] == "starting"
        assert "no X server" in second.status()["reason"]
        assert any("STATUS=starting (waiting for a panel: no X server" in heard for heard in second.heard)
        second.heard.clear()
        for _ in range(3):
            assert second.hears("WATCHDOG=1")
            second.heard.clear()
        x.append(xserver.XServer(tmp_path, display=x[0].number))
        assert eventually(lambda: shows_something_on(x))
        second.process.send_signal(signal.SIGTERM)
        code, errors = second.ends()
        assert code == 0
        assert errors.count("waiting for a panel: no X server") == 1  # in the journal
    finally:
        second.close()
