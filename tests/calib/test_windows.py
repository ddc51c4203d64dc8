"""Charts and verniers on real windows of a real X server, with keys that are really pressed."""

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

from calib.charts import eye_chart
from calib.vernier import nominal, read_settings
from calib.viewpoints import grid
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
RETURN, RIGHT, Q = 0xFF0D, 0xFF53, 0x71  # X key symbols


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


def test_charts_are_shown_one_after_the_other(screen: xserver.XServer, phasestack: Any) -> None:
    viewpoint = grid()[4]
    running = phasestack("charts", "--show", "--kind", "seed", "--viewpoint", viewpoint.name)
    charts = [
        eye_chart(viewpoint, STACK, side=side, index=index, ipd_m=0.06) for index in range(2) for side in range(2)
    ]
    assert shows(screen, 0, charts[0])
    assert not screen.panel(1).any()
    assert not screen.panel(2).any()
    press(screen, RETURN)
    assert shows(screen, 0, charts[1])
    running.stdin.write(b"n")
    running.stdin.flush()
    assert shows(screen, 1, charts[2])
    assert not screen.panel(0).any()
    press(screen, Q)
    assert running.wait(timeout=60) == 0


def test_a_vernier_is_nudged_with_the_keyboard_and_kept(
    screen: xserver.XServer, phasestack: Any, tmp_path: Path
) -> None:
    out = tmp_path / "vernier.csv"
    running = phasestack("panels", "vernier", "--eye", "0.5", "0", "0", "--out", str(out))
    assert eventually(lambda: screen.panel(0).any() and screen.panel(1).any(), within_s=30)
    press(screen, RIGHT)
    press(screen, RETURN)
    assert eventually(out.exists)
    running.stdin.close()
    assert running.wait(timeout=60) == 0
    asked, (taken,) = nominal((0.5, 0.0, 0.0), STACK, reference=1)[0], read_settings(out, STACK)
    assert taken.panel_px == pytest.approx((asked.panel_px[0] + 1.0, asked.panel_px[1]))
