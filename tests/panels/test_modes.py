"""A monitor must show the stack's own pixels, and all panels at one rate: else phases are rescaled, or frames torn."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.doctor import doctor
from runtime.config import PanelSettings
from runtime.errors import PanelLost
from runtime.panels.modes import check_mode, refresh_difference
from runtime.panels.monitors import Monitor
from tests.panels.xserver import XServer

FULL = Monitor("DP-1", "A", "EIZ", 0, 0, 1920, 1080, 60.0)
STACK = {"width_px": 1920, "height_px": 1080}


def test_a_mode_of_the_stacks_shape_but_not_its_pixels_is_refused_unless_rescaling_is_allowed() -> None:
    small = replace(FULL, width_px=1280, height_px=720)
    check_mode(0, PanelSettings(), FULL, **STACK, allow_rescaling=False)
    with pytest.raises(PanelLost, match=r"panel 1: DP-1 shows 1280x720, the stack is 1920x1080: .*allow_rescaling"):
        check_mode(1, PanelSettings(), small, **STACK, allow_rescaling=False)
    check_mode(1, PanelSettings(), small, **STACK, allow_rescaling=True)


def test_a_panel_that_stands_on_its_side_is_compared_as_it_is_seen() -> None:
    upright = replace(FULL, width_px=1080, height_px=1920)
    check_mode(0, PanelSettings(rotation_deg=90), upright, **STACK, allow_rescaling=False)
    with pytest.raises(PanelLost):
        check_mode(0, PanelSettings(), upright, **STACK, allow_rescaling=False)


def test_rates_that_drift_apart_are_told_and_unknown_ones_are_not_guessed_at() -> None:
    assert refresh_difference([FULL, replace(FULL, connector="DP-2", refresh_hz=59.98)]) == ""
    assert refresh_difference([FULL, replace(FULL, refresh_hz=0.0)]) == ""
    told = refresh_difference([FULL, replace(FULL, connector="DP-2", refresh_hz=59.94)])
    assert "DP-1 60.00 Hz, DP-2 59.94 Hz" in told


def test_the_doctor_fails_monitors_of_another_mode_and_passes_them_where_rescaling_is_allowed(
    screen: XServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", screen.name)
    state, detail = panels_row(tmp_path, "")
    assert state == "fail" and "shows 320x180, the stack is 1920x1080" in detail
    assert panels_row(tmp_path, "allow_rescaling = true")[0] == "ok"


def written(folder: Path, more: str) -> Path:
    config = folder / "phasestack.toml"
    panels = "".join(f'[[output.panels]]\nconnector = "DUMMY{n}"\n' for n in range(3))
    config.write_text(f'[output]\nkind = "windows"\n{more}\n{panels}[service]\nsocket = "status.sock"\n')
    return config


def panels_row(folder: Path, more: str) -> tuple[str, str]:
    config = written(folder, more)
    app = typer.Typer()
    app.command()(doctor)
    result = CliRunner().invoke(app, ["--json", "--config", str(config)])
    row = next(check for check in json.loads(result.stdout)["checks"] if check["name"] == "panels")
    return row["state"], row["detail"]
