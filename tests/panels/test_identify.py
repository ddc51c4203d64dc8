"""Tests `phasestack identify` and the doctor's view of monitors, on real windows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import pytest

from runtime.commands.doctor import doctor, monitors
from runtime.commands.identify import identify
from runtime.config import load_settings
from runtime.errors import InputError
from runtime.panels.card import BARS, identity_card
from runtime.panels.geometry import mounting_of, panel_from_screen
from tests.calls import invoked
from tests.panels.edids import block
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX, XServer
from tests.waiting import eventually

STACK = f"""
[stack]
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
"""
BOUND = f"""{STACK}
[output]
kind = "windows"
[[output.panels]]
connector = "DUMMY2"
rotation_deg = 180
[[output.panels]]
edid_serial = "A1B2-0003"
[[output.panels]]
connector = "DUMMY0"
"""


@pytest.fixture
def x(screen: XServer, monkeypatch: pytest.MonkeyPatch) -> XServer:
    monkeypatch.setenv("DISPLAY", screen.name)
    screen.set_edid(0, bytes(128))
    screen.set_edid(1, block(serial_text="A1B2-0003"))
    screen.set_edid(2, bytes(128))
    return screen


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "phasestack.toml"
    path.write_text(BOUND)
    return path


@contextmanager
def started(x: XServer, *arguments: Path | str) -> Iterator[Popen[Any]]:
    """The command in a separate process, with the test's keys."""
    command = [sys.executable, "-m", "runtime.cli", "identify", *map(str, arguments)]
    # The type of a session says nothing about the X server that DISPLAY names.
    environment = os.environ | {"DISPLAY": x.name, "OMP_NUM_THREADS": "1", "XDG_SESSION_TYPE": "wayland"}
    with Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


@pytest.mark.windows
def test_without_a_configuration_every_monitor_tells_how_to_name_it(x: XServer) -> None:
    with started(x) as running:
        assert eventually(lambda: (x.panel(0)[0] == 255).all(), within_s=20.0)
        said, _ = running.communicate("q", timeout=60)
    assert running.returncode == 0
    assert 'EIZ CG2700X (320x180+320+0, serial A1B2-0003): [[output.panels]] edid_serial = "A1B2-0003"' in said
    assert '[[output.panels]] connector = "DUMMY2"' in said


@pytest.mark.windows
def test_configured_panels_are_shown_as_mounted_and_keys_step_through_them(x: XServer, config: Path) -> None:
    bars = round(HEIGHT_PX * 0.85)

    def turned() -> bool:
        return tuple(x.panel(2)[HEIGHT_PX - 1 - bars, -13]) == BARS[0]

    with started(x, "--config", config) as running:
        assert eventually(turned, within_s=20.0)
        # Rear to front are monitors 2, 1, 0.
        for monitor, key in ((2, "n"), (1, "n"), (0, "p"), (1, "q")):
            lit = [n == monitor for n in range(3)]
            assert eventually(lambda lit=lit: [bool(panel.any()) for panel in x.panels()] == lit, within_s=20.0)
            running.stdin.write(key)
            running.stdin.flush()
        assert "panel 0: DUMMY2" in running.communicate(timeout=60)[0] and running.returncode == 0


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", ["none", "horizontal"])
def test_the_mounting_that_is_answered_shows_the_card_upright(rotation_deg: int, mirror: str) -> None:
    """An unrotated card on a mounted panel: the arrow's direction gives the mounting."""
    card_points_up = np.array([0.0, -1.0])
    seen = panel_from_screen(screen_width_px=4, screen_height_px=3, rotation_deg=rotation_deg, mirror=mirror)
    direction = tuple(np.rint(seen[:2, :2] @ card_points_up).astype(int))
    arrow = {(0, -1): "up", (0, 1): "down", (-1, 0): "left", (1, 0): "right"}[direction]
    assert mounting_of(arrow, mirrored=mirror == "horizontal") == (rotation_deg, mirror)


def test_without_a_screen_it_says_so_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    result = invoked(identify)
    assert isinstance(result.exception, InputError)
    assert "no X server" in str(result.exception)


@pytest.mark.windows
def test_the_doctor_lists_bound_monitors_and_names_a_missing_one(
    x: XServer, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.commands.doctor.CHECKS", (monitors,))
    checks = json.loads(invoked(doctor, "--json", "--config", config).stdout)["checks"]
    assert any("A1B2-0003" in check["detail"] for check in checks if check["name"] == "monitor")
    assert [check["state"] for check in checks if check["name"] == "panels"] == ["ok"] * 3
    assert not any(check["remedy"] for check in checks)  # a monitor without a serial is bound by its connector
    config.write_text(BOUND.replace("A1B2-0003", "ANOTHER"))
    result = invoked(doctor, "--json", "--config", config)
    failed = {check["name"]: check for check in json.loads(result.stdout)["checks"] if check["state"] == "fail"}
    assert result.exit_code == 1
    assert "panel 1: no monitor has EDID serial ANOTHER" in failed["panels"]["detail"]
    assert "identify" in failed["panels"]["remedy"]


def found_in(state: str, folder: Path) -> list[str]:
    """Findings of this state about monitors that are bound by their connectors."""
    panels = ", ".join(f'{{ connector = "DUMMY{n}" }}' for n in range(3))
    (folder / "a.toml").write_text(f"{STACK}[output]\nkind = 'windows'\npanels = [{panels}]")
    return [row.detail for row in monitors(load_settings(folder / "a.toml")) if row.state == state]


@pytest.mark.windows
def test_the_doctor_finds_a_gamma_set_by_the_x_server(x: XServer, tmp_path: Path) -> None:
    dimmed = ("1:1:1", "1", 0), ("1:0.8:0.6", "1", 1), ("1:1:1", "0.994", 1), ("1:1:1", "0.997", 0)  # by 1/255: none
    try:
        for gamma, brightness, count in (*dimmed, ("1:1:1", "1", 0)):
            x.xrandr("--output", "DUMMY1", "--gamma", gamma, "--brightness", brightness)
            warned = found_in("warn", tmp_path)
            assert len(warned) == count
            assert all("grey levels of DUMMY1 (gamma, brightness or a night light)" in told for told in warned)
    finally:
        x.xrandr("--output", "DUMMY1", "--gamma", "1:1:1", "--brightness", "1")


@pytest.mark.windows
def test_the_doctor_refuses_monitors_that_are_mirrored_on_each_other(x: XServer, tmp_path: Path) -> None:
    x.xrandr("--output", "DUMMY2", "--same-as", "DUMMY1")
    try:
        (failure,) = found_in("fail", tmp_path)
    finally:
        x.place(0, 1, 2)
    assert failure.startswith("panels 1 and 2 would show the same pixels")


CARDS = {
    (1600, 900): {  # rows and columns of a region, and those of the ink
        (30, 240, 30, 1100): (108, 239, 204, 295),  # title
        (262, 347, 30, 1130): (331, 339, 193, 1083),  # a long line fills its room
        (350, 600, 30, 1100): (368, 415, 202, 217),  # the next line
        (30, 585, 1130, 1275): (107, 576, 1159, 1274),  # arrow
        (232, 400, 1284, 1500): (288, 344, 1291, 1385),  # UP
        (594, 675, 1130, 1500): (602, 641, 1162, 1363),  # RIGHT
    },
    (900, 1600): {
        (200, 450, 30, 540): (290, 421, 120, 211),
        (500, 530, 30, 680): (516, 520, 108, 609),
        (540, 800, 30, 540): (550, 597, 118, 133),
        (120, 1030, 540, 870): (198, 1017, 540, 852),
        (500, 650, 730, 870): (554, 610, 745, 839),
        (1030, 1150, 540, 870): (1043, 1082, 616, 817),
    },
}


@pytest.mark.parametrize("size_px", CARDS)
def test_a_card_has_edges_bars_steps_an_arrow_and_text(size_px: tuple[int, int]) -> None:
    width, height = size_px
    card = identity_card(width, height, title="0", lines=["long " * 40, "1"])
    assert card.shape == (height, width, 4) and (card[..., 3] == 255).all()
    ink = card[..., :3].min(-1) > 130
    assert ink[[0, -1]].all() and ink[:, [0, -1]].all() and not ink[1, 1:-1].any() and not ink[1:-1, 1].any()
    assert (card[[27, -28], 27:-27, :3] == (120, 130, 150)).all() and (card[27:-27, [27, -28], 0] == 120).all()
    assert (card[[2, 26, 28], 400, :3] == (24, 28, 36)).all() and (card[400, [2, 26, 28], :3] == (24, 28, 36)).all()
    bars = ["ff0000", "00ff00", "0000ff", "00ffff", "ff00ff", "ffff00", "ffffff"]
    for row, colours in ((0.77, bars), (0.87, bars), (0.89, [f"{17 * n:02x}" * 3 for n in range(16)])):
        count = len(colours)
        for side in (30, -3):  # columns from the edges of a bar
            columns = [width * (n + (side < 0)) // count + side for n in range(count)]
            assert [bytes(pixel).hex() for pixel in card[round(row * height), columns, :3]] == colours
    for region, expected in CARDS[size_px].items():
        top, bottom, left, right = region
        rows, columns = (np.flatnonzero(ink[top:bottom, left:right].any(axis)) for axis in (1, 0))
        found = [top + rows[0], top + rows[-1], left + columns[0], left + columns[-1]]
        assert found == pytest.approx(expected, abs=2), region
