"""Tests `phasestack run` under a notification socket, with signals and a changing configuration."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from signal import Signals
from typing import Any

import pytest

from runtime.config import Settings
from runtime.daemon.build import RunOptions, build_run
from runtime.daemon.client import ask
from runtime.errors import InputError
from tests.daemon.test_notify import Supervisor
from tests.waiting import PATIENT, eventually

CONFIG = """
[stack]
width_px = 192
height_px = 108
[sensor]
loop = true
[model]
name = "fast"
threads = 1
backend = "cpu"
[loop]
rate_hz = 60.0
[service]
socket = "{folder}/status.sock"
"""


PHASESTACK = (sys.executable, "-c", PATIENT)


class Daemon:
    """One process of `phasestack run`."""

    def __init__(
        self,
        folder: Path,
        *extra: str,
        config: str = CONFIG,
        watchdog_s: float = 0.0,
        headless: bool = True,
        **streams: Any,
    ) -> None:
        self.socket = folder / "status.sock"
        self.config = folder / "phasestack.toml"
        self.config.write_text(config.format(folder=folder))
        self.supervisor = Supervisor(str(folder / "notify"))
        self.heard: list[str] = []
        environment = {**os.environ, "NOTIFY_SOCKET": str(folder / "notify"), "OMP_NUM_THREADS": "1"}
        if watchdog_s:
            environment["WATCHDOG_USEC"] = str(int(watchdog_s * 1e6))
        arguments = ["run", "--config", str(self.config), "--replay", "demo", *extra]
        if headless:
            arguments.append("--headless")
        given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
        self.process = subprocess.Popen([*PHASESTACK, *arguments], env=environment, text=True, **given)

    def hears(self, message: str, *, within_s: float = 90.0) -> bool:
        deadline = time.monotonic() + within_s
        while time.monotonic() < deadline:
            self.heard += self.supervisor.heard()
            if any(message in heard for heard in self.heard):
                return True
            if self.process.poll() is not None:
                return False
            time.sleep(0.02)
        return False

    def status(self) -> dict:
        return ask([self.socket], {"command": "status"})

    def ends(self) -> tuple[int, str]:
        _, errors = self.process.communicate(timeout=90)
        self.heard += self.supervisor.heard()
        return self.process.returncode, errors

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        if self.process.stderr is None:
            self.process.wait(90)
        elif not self.process.stderr.closed:
            self.process.communicate(timeout=90)
        self.supervisor.close()


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    made: list[Daemon] = []

    def start(*extra: str, **keywords: float | str) -> Daemon:
        folder = tmp_path / str(len(made))
        folder.mkdir()
        made.append(Daemon(folder, *extra, **keywords))
        return made[-1]

    yield start
    for daemon in made:
        daemon.close()


@pytest.mark.parametrize(("number", "after_s"), [(signal.SIGTERM, 0.05), (signal.SIGTERM, 1.6), (signal.SIGINT, 1.0)])
def test_a_signal_at_any_stage_of_the_start_ends_it_cleanly(
    started: Callable[..., Any], number: Signals, after_s: float
) -> None:
    daemon = started()
    time.sleep(after_s)
    daemon.process.send_signal(number)
    code, errors = daemon.ends()
    # Before our handlers are there a signal kills; 130 is what shells make of an interrupt.
    assert code in (0, 130, -number), errors
    assert "Traceback" not in errors


def test_it_becomes_ready_by_presenting_is_steered_and_ends_in_order(started: Callable[..., Any]) -> None:
    daemon = started(watchdog_s=2.0)
    assert daemon.hears("READY=1")
    assert daemon.status()["presented"] >= 1
    assert daemon.hears("WATCHDOG=1")
    assert ask([daemon.socket], {"command": "flat"})["ok"]
    assert daemon.hears("STATUS=flat (requested)")
    assert ask([daemon.socket], {"command": "resume"})["ok"]
    assert daemon.hears("STATUS=tracking")
    refused = ask([daemon.socket], {"command": "scene", "value": "no-such-scene"})
    assert not refused["ok"] and "no-such-scene" in refused["error"]
    assert ask([daemon.socket], {"command": "pause"})["ok"]
    frames = daemon.status()["frames"]
    assert eventually(lambda: daemon.status()["frames"] > frames)  # a still picture, not a still loop
    assert ask([daemon.socket], {"command": "resume"})["ok"]
    daemon.config.write_text("[loop]\nrate_hz = -1\n")
    daemon.process.send_signal(signal.SIGHUP)
    assert daemon.hears("RELOADING=1")
    assert eventually(lambda: "rate_hz" in daemon.status().get("refused", ""))
    refused = ask([daemon.socket], {"command": "reload"})
    assert not refused["ok"] and "rate_hz" in refused["error"]
    assert eventually(lambda: daemon.status()["state"] == "tracking")  # a busy machine may have starved its sensor
    daemon.process.send_signal(signal.SIGTERM)
    code, errors = daemon.ends()
    assert code == 0
    assert any(message.startswith("STOPPING=1") for message in daemon.heard)
    assert "SIGTERM" in errors and not daemon.socket.exists()
    told = errors.splitlines()
    assert any("state: starting ->" in line for line in told)
    assert sum("refused" in line and "rate_hz" in line for line in told) == 2


PANEL = '[[output.panels]]\nconnector = "HDMI-%d"\n'
NO_SCREEN = CONFIG + '[output]\nkind = "windows"\n' + "".join(PANEL % n for n in range(3))


def test_a_panel_missing_at_the_start_is_waited_for_as_a_state(
    started: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    daemon = started(config=NO_SCREEN, headless=False)
    assert daemon.hears("READY=1")
    assert daemon.hears("EXTEND_TIMEOUT_USEC=")
    assert daemon.hears("waiting for a panel")
    assert "no X server" in daemon.status()["reason"]
    daemon.process.send_signal(signal.SIGTERM)
    code, errors = daemon.ends()
    assert "Traceback" not in errors
    assert code == 0


def test_why_it_cannot_start_is_its_last_word_to_the_supervisor(started: Callable[..., Any]) -> None:
    daemon = started(config="[stack]\nwidth_px = 'wide'\n")
    assert daemon.ends()[0] == 2
    assert daemon.hears("STATUS=phasestack: ")
    assert "width_px" in daemon.heard[-1]


def test_monitors_do_not_take_a_scaled_stack() -> None:
    settings = Settings.model_validate({"output": {"kind": "windows"}})
    with pytest.raises(InputError, match="run: --scale: requires --headless"), ExitStack() as cleanup:
        build_run(settings, RunOptions(scale=0.5), cleanup)


def test_by_hand_a_missing_panel_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    config = tmp_path / "phasestack.toml"
    config.write_text(NO_SCREEN.format(folder=tmp_path))
    environment = {name: value for name, value in os.environ.items() if name != "NOTIFY_SOCKET"}
    command = [*PHASESTACK, "run", "--config", str(config), "--replay", "demo"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert result.returncode == 75  # there may be one later
    assert "no X server" in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("reader", ["never reads", "was never there"])
def test_without_a_reader_of_its_log_the_display_goes_on_and_ends(started: Callable[..., Any], reader: str) -> None:
    out, descriptor = os.pipe()
    if reader == "never reads":
        os.set_blocking(descriptor, False)
        with suppress(BlockingIOError):
            while os.write(descriptor, b"x" * 4096):  # full from the start
                pass
        os.set_blocking(descriptor, True)
    streams: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": descriptor}
    if reader == "was never there":
        streams = {"stdout": None, "stderr": None, "preexec_fn": lambda: os.closerange(1, 3)}
    daemon = started(**streams)
    os.close(descriptor)
    assert daemon.hears("READY=1")
    for command in ("flat", "resume"):
        assert ask([daemon.socket], {"command": command}, timeout_s=30)["ok"]
    before = daemon.status()["presented"]
    assert eventually(lambda: daemon.status()["presented"] > before + 10)
    daemon.process.send_signal(signal.SIGTERM)
    assert daemon.process.wait(timeout=60) == 0
    os.close(out)
