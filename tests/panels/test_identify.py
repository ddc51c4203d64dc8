"""`phasestack identify` and the doctor's view of monitors, on real windows."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.doctor import doctor
from runtime.commands.identify import identify
from runtime.errors import InputError
from runtime.panels.card import BARS, identity_card
from runtime.support.artifacts import read_image
from tests.panels.edids import block
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX
from tests.waiting import eventually

BOUND = f"""
[stack]
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
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


def invoke(command, *arguments):
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def x(screen, monkeypatch):
    monkeypatch.setenv("DISPLAY", screen.name)
    screen.set_edid(0, bytes(128))
    screen.set_edid(1, block(serial_text="A1B2-0003"))
    screen.set_edid(2, bytes(128))
    return screen


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "phasestack.toml"
    path.write_text(BOUND)
    return path


def card(title: str, *lines: str) -> np.ndarray:
    return identity_card(WIDTH_PX, HEIGHT_PX, title=title, lines=lines)


def test_a_card_shows_its_edges_and_its_colours():
    picture = card("PANEL 0", "rear")
    for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
        assert (edge == 255).all()
    row = picture[round(HEIGHT_PX * 0.85), :, :3]
    assert {tuple(colour) for colour in row.tolist()} >= set(BARS)


def test_no_turning_or_mirroring_of_a_card_looks_like_it():
    picture = card("PANEL 0")
    for other in (picture[::-1], picture[:, ::-1], picture[::-1, ::-1]):
        assert not np.array_equal(picture, other)


@pytest.mark.parametrize("size", [(64, 36), (1920, 1080), (1080, 1920)])
def test_cards_fit_any_monitor(size):
    picture = identity_card(*size, title="DisplayPort-1-8 ä", lines=["a line that is far too long for it " * 5] * 5)
    assert picture.shape == (size[1], size[0], 4)


def shown_during(command, *arguments, when):
    """The command's result, and whether `when` held while it ran."""
    held = []
    watcher = threading.Thread(target=lambda: held.append(eventually(when, within_s=8.0)))
    watcher.start()
    result = invoke(command, *arguments)
    watcher.join()
    return result, held[0]


@pytest.mark.windows
def test_without_a_configuration_every_monitor_tells_how_to_name_it(x):
    result, seen = shown_during(
        identify, "--seconds", 1.5, when=lambda: all((x.panel(index)[0] == 255).all() for index in range(3))
    )
    assert result.exit_code == 0
    assert seen
    assert 'EIZ CG2700X (320x180+320+0, serial A1B2-0003): [[output.panels]] edid_serial = "A1B2-0003"' in result.stdout
    assert '[[output.panels]] connector = "DUMMY2"' in result.stdout
    assert "DUMMY2 has no EDID serial" in result.stdout


@pytest.mark.windows
def test_with_a_configuration_panels_are_shown_as_they_will_be(x, config):
    bars = round(HEIGHT_PX * 0.85)

    def upright_but_for_the_turned_one() -> bool:
        turned, upright = x.panel(2), x.panel(0)
        return tuple(upright[bars, 12]) == BARS[0] and tuple(turned[HEIGHT_PX - 1 - bars, -13]) == BARS[0]

    result, seen = shown_during(identify, "--seconds", 1.5, "--config", config, when=upright_but_for_the_turned_one)
    assert result.exit_code == 0
    assert seen
    assert "panel 0: DUMMY2" in result.stdout


def test_it_can_write_pictures_where_there_is_no_screen(tmp_path, config, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    result = invoke(identify, "--config", config, "--out", tmp_path / "cards")
    assert result.exit_code == 0
    pictures = [read_image(tmp_path / "cards" / f"monitor-{index}.png") for index in range(3)]
    bars = round(HEIGHT_PX * 0.85)
    assert tuple(pictures[1][bars, 12]) == BARS[0]
    assert tuple(pictures[0][HEIGHT_PX - 1 - bars, -13]) == BARS[0]


def test_without_a_screen_it_says_so_in_one_line(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    result = invoke(identify, "--seconds", 1)
    assert isinstance(result.exception, InputError)
    assert "no X server" in str(result.exception)


@pytest.mark.windows
def test_the_doctor_lists_monitors_and_their_binding(x, config):
    checks = json.loads(invoke(doctor, "--json", "--config", config).stdout)["checks"]
    monitors = [check["detail"] for check in checks if check["name"] == "monitor"]
    assert any("A1B2-0003" in monitor for monitor in monitors)
    assert [check["state"] for check in checks if check["name"] == "panels"] == ["ok"] * 3


@pytest.mark.windows
def test_the_doctor_names_a_panel_whose_monitor_is_missing(x, config):
    config.write_text(BOUND.replace("A1B2-0003", "ANOTHER"))
    result = invoke(doctor, "--json", "--config", config)
    failed = {check["name"]: check for check in json.loads(result.stdout)["checks"] if check["state"] == "fail"}
    assert result.exit_code == 1
    assert "panel 1: no monitor with EDID serial ANOTHER" in failed["panels"]["detail"]
    assert "identify" in failed["panels"]["remedy"]
