"""Tests `phasestack setup` and `calibrate` on windows of a real X server, with simulated key presses."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from calib.board import board
from calib.grey_chart import grey_chart
from runtime.config import load_settings
from runtime.optics.stack import PanelStack
from runtime.support.artifacts import write_png
from tests.panels import xserver
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX
from tests.waiting import eventually

pytestmark = pytest.mark.windows
STACK = PanelStack(0.5, 0.28, (-0.06, 0.0, 0.06), WIDTH_PX, HEIGHT_PX)
CONFIG = f"[stack]\nwidth_m = 0.5\nheight_m = 0.28\nwidth_px = {WIDTH_PX}\nheight_px = {HEIGHT_PX}\n"


@pytest.fixture(scope="module")
def screen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[xserver.XServer]:
    server = xserver.start_or_skip(tmp_path_factory.mktemp("xorg"))
    yield server
    server.stop()


def shows(screen: xserver.XServer, panel: int, picture: np.ndarray) -> bool:
    return np.array_equal(screen.panel(panel)[..., 0], picture)


def test_keys_lead_through_cards_and_boards_on_the_panels(screen: xserver.XServer, tmp_path: Path) -> None:
    config, photos = tmp_path / "c.toml", tmp_path / "photos"
    config.write_text(CONFIG + '[model]\nname = "fast"\n')
    for number in range(5):
        write_png(photos / f"{number}.png", np.full((90, 120), 128, np.uint8))
    command = [sys.executable, "-m", "runtime.cli", "setup", "--config", str(config), "--out", str(tmp_path / "out"),
               "--photos", str(photos)]  # fmt: skip
    environment = os.environ | {"DISPLAY": screen.name, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as running:

        def press(keys: str) -> None:
            running.stdin.write(keys)
            running.stdin.flush()

        def lit() -> list[bool]:
            return [bool(screen.panel(index).any()) for index in range(3)]

        try:
            up = "\x1b[A"
            press("\n")
            for monitor in range(3):  # rear, middle, front: from left to right
                alone = [index == monitor for index in range(3)]
                assert eventually(lambda alone=alone: lit() == alone, within_s=60)
                press("\n" + up + "\n")
            press("n\n\n")
            for monitor in range(3):
                shown = partial(shows, screen, monitor, board(STACK, monitor))
                assert eventually(shown, within_s=60)
            # The photographs exist but show no board, which is reported.
            output = running.communicate("\nq\n", timeout=120)[0]
        finally:
            running.kill()
    assert running.returncode == 0 and output.count("Step 3 of 7") == 2 and "failed:" in output
    assert "0 of 5 photographs are usable, but at least 5 are needed" in output
    assert "not done: geometry, registration, grey, sensor, calibration, service" in output
    settings = load_settings(config)
    connectors = [panel.connector for panel in settings.output.panels]
    assert settings.output.kind == "windows" and connectors == ["DUMMY0", "DUMMY1", "DUMMY2"]
    assert all(panel.homography[0][0] == 1.0 for panel in settings.output.panels)


def press_q(screen: xserver.XServer) -> None:
    """On the keyboard, the pointer over the first panel: without a window manager that is where it goes."""
    x11, xtst = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXtst.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = ctypes.c_void_p(x11.XOpenDisplay(screen.name.encode()))
    code = x11.XKeysymToKeycode(display, ctypes.c_ulong(0x71))
    xtst.XTestFakeMotionEvent(display, 0, 100, 100, 0)
    for down in (1, 0):
        xtst.XTestFakeKeyEvent(display, code, down, ctypes.c_ulong(0))
    x11.XCloseDisplay(display)


def test_a_chart_is_shown_until_a_key_is_pressed_on_a_panel(screen: xserver.XServer, tmp_path: Path) -> None:
    panels = "".join(f'[[output.panels]]\nconnector = "DUMMY{index}"\n' for index in range(3))
    (tmp_path / "c.toml").write_text(f'{CONFIG}[output]\nkind = "windows"\n{panels}')
    command = [sys.executable, "-m", "runtime.cli", "calibrate", "grey", "--panel", "1", "--show", "--config",
               str(tmp_path / "c.toml")]  # fmt: skip
    environment = os.environ | {"DISPLAY": screen.name, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as running:
        try:
            assert eventually(partial(shows, screen, 1, grey_chart(STACK, 1)), within_s=30)
            assert not screen.panel(0).any() and not screen.panel(2).any()
            press_q(screen)
            assert running.wait(timeout=60) == 0
        finally:
            running.kill()
