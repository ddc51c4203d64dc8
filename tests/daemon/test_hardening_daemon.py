"""A whole daemon whose diagnostics are lost: the display goes on, and it can be ended."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from runtime.daemon.client import ask
from tests.daemon.test_daemon import CONFIG, PHASESTACK
from tests.waiting import eventually


class Daemon:
    """`phasestack run` with standard output and error of a test's choice."""

    def __init__(self, folder: Any, *, stdout: Any, stderr: Any, preexec_fn: Any = None) -> None:
        self.socket, config = folder / "status.sock", folder / "phasestack.toml"
        config.write_text(CONFIG.format(folder=folder))
        self.process = subprocess.Popen(
            [*PHASESTACK, "run", "--config", str(config), "--replay", "demo", "--headless"],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            preexec_fn=preexec_fn,
        )

    def presented(self) -> int:
        return ask([self.socket], {"command": "status"}, timeout_s=30)["presented"]

    def goes_on(self) -> bool:
        """It comes up, and shows more than it has shown."""
        assert eventually(self.socket.exists, within_s=60)
        assert eventually(lambda: self.answers() and self.presented() > 5, within_s=60)
        before = self.presented()
        return eventually(lambda: self.presented() > before + 10, within_s=30)

    def answers(self) -> bool:
        try:
            return "presented" in ask([self.socket], {"command": "status"}, timeout_s=30)
        except Exception:
            return False

    def ends(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=60)


@pytest.fixture
def started(tmp_path: Path) -> Any:
    made = []

    def start(**streams: Any) -> Daemon:
        made.append(Daemon(tmp_path, **streams))
        return made[-1]

    yield start
    for daemon in made:
        if daemon.process.poll() is None:
            daemon.process.kill()
            daemon.process.wait()


def test_a_log_reader_that_never_reads_stops_neither_the_display_nor_its_end(started: Callable[..., Any]) -> None:
    out, descriptor = os.pipe()
    os.set_blocking(descriptor, False)
    try:
        while os.write(descriptor, b"x" * 4096):  # full from the start
            pass
    except BlockingIOError:
        os.set_blocking(descriptor, True)
    daemon = started(stdout=subprocess.DEVNULL, stderr=descriptor)
    os.close(descriptor)
    try:
        assert daemon.goes_on()
        for _ in range(3):
            assert ask([daemon.socket], {"command": "flat"}, timeout_s=30)["ok"]
            assert ask([daemon.socket], {"command": "resume"}, timeout_s=30)["ok"]
        begin_s = time.monotonic()
        assert daemon.ends() == 0
        assert time.monotonic() - begin_s < 30
    finally:
        os.close(out)


def test_a_log_reader_that_dies_is_survived_and_the_lost_lines_are_told_in_the_status(
    started: Callable[..., Any],
) -> None:
    out, descriptor = os.pipe()
    daemon = started(stdout=subprocess.DEVNULL, stderr=descriptor)
    os.close(descriptor)
    os.close(out)
    assert daemon.goes_on()
    assert ask([daemon.socket], {"command": "status"}, timeout_s=30)["log_lines_lost"] > 0
    daemon.ends()


def test_closed_standard_descriptors_are_survived(started: Callable[..., Any]) -> None:
    def close() -> None:
        os.close(1)
        os.close(2)

    daemon = started(stdout=None, stderr=None, preexec_fn=close)
    assert daemon.goes_on()
    daemon.ends()
