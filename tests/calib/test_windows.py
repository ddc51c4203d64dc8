"""A chart on real windows of a real X server, with keys that are really pressed."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.grey_chart import grey_chart
from runtime.optics.stack import PanelStack
from tests.panels import xserver
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX
from tests.waiting import eventually

pytestmark = pytest.mark.windows
STACK = PanelStack(0.5, 0.28, (-0.06, 0.0, 0.06), WIDTH_PX, HEIGHT_PX)
CONFIG = f"""
[stack]
width_m = 0.5
height_m = 0.28
x_m = [-0.06, 0.0, 0.06]
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
[output]
kind = "windows"
""" + "".join(f'[[output.panels]]\nconnector = "DUMMY{index}"\n' for index in range(3))
Q = 0x71  # X key symbol


@pytest.fixture(scope="module")
def screen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[xserver.XServer]:
    server = xserver.start_or_skip(tmp_path_factory.mktemp("xorg"))
    yield server
    server.stop()


@pytest.fixture
def phasestack(screen: xserver.XServer, tmp_path: Path) -> Any:
    """The command in a process of its own, its panels on the virtual monitors."""
    (tmp_path / "config.toml").write_text(CONFIG)
    running = []

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        command = [
            sys.executable,
            "-m",
            "runtime.cli",
            "calibrate",
            *arguments,
            "--config",
            str(tmp_path / "config.toml"),
        ]
        environment = os.environ | {"DISPLAY": screen.name, "OMP_NUM_THREADS": "1"}
        running.append(subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL))
        return running[-1]

    yield start
    for process in running:
        if process.poll() is None:
            process.kill()
        process.stdin.close()
        process.wait(timeout=60)


def press(screen: xserver.XServer, symbol: int) -> None:
    """A key on the keyboard, the pointer over the first panel: without a window manager that is where it goes."""
    x11, xtst = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXtst.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = ctypes.c_void_p(x11.XOpenDisplay(screen.name.encode()))
    code = x11.XKeysymToKeycode(display, ctypes.c_ulong(symbol))
    xtst.XTestFakeMotionEvent(display, 0, 100, 100, 0)
    for down in (1, 0):
        xtst.XTestFakeKeyEvent(display, code, down, ctypes.c_ulong(0))
    x11.XCloseDisplay(display)


def shows(screen: xserver.XServer, monitor: int, expected: np.ndarray) -> bool:
    return eventually(lambda: np.array_equal(screen.panel(monitor)[..., 0], expected), within_s=30)


def test_a_chart_is_shown_until_a_key_is_pressed_on_a_panel(screen: xserver.XServer, phasestack: Any) -> None:
    running = phasestack("grey", "--panel", "1", "--show")
    assert shows(screen, 1, grey_chart(STACK, 1))
    assert not screen.panel(0).any()
    assert not screen.panel(2).any()
    press(screen, Q)
    assert running.wait(timeout=60) == 0
