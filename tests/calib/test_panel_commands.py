"""`calibrate panels`: from a CSV of settings to the configuration, and a simulation of the whole."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calib.commands import app
from calib.cost_run import misaligned
from calib.registration import error_over_panel_px
from calib.vernier import nominal, read_settings, simulate, write_settings
from runtime.config import StackGeometry, load_settings
from runtime.errors import InputError
from runtime.support.artifacts import read_image

run = CliRunner()
STACK = StackGeometry().stack()
CONFIG = """# the installer's own words
[content]
scene = "demo"  # kept

[[output.panels]]
connector = "HDMI-1"
[[output.panels]]
connector = "HDMI-2"
rotation_deg = 180
[[output.panels]]
connector = "HDMI-3"
"""


def panels(*options: str) -> dict:
    result = run.invoke(app, ["panels", *options, "--json"])
    if result.exception is not None:
        raise result.exception
    return json.loads(result.stdout)


@pytest.fixture
def truth() -> list[np.ndarray]:
    return misaligned(STACK, reference=1, random=np.random.default_rng(4))


@pytest.fixture
def vernier(tmp_path: Path, truth: list[np.ndarray]) -> Path:
    asked = nominal((0.5, 0.0, 0.0), STACK, reference=1)
    taken = simulate(asked, STACK, truth, noise_px=0.05, viewpoint_error_m=np.zeros(3), random=np.random.default_rng(0))
    write_settings(tmp_path / "vernier.csv", taken)
    return tmp_path / "vernier.csv"


def test_the_homographies_go_into_the_configuration_and_all_else_stays(
    tmp_path: Path, vernier: Path, truth: list[np.ndarray]
) -> None:
    config = tmp_path / "config.toml"
    config.write_text(CONFIG)
    told = panels("fit", "--vernier", str(vernier), "--out", str(tmp_path / "r"), "--config", str(config), "--write")
    text = config.read_text()
    assert "# the installer's own words" in text
    assert "# kept" in text
    settings = load_settings(config)
    assert [panel.connector for panel in settings.output.panels] == ["HDMI-1", "HDMI-2", "HDMI-3"]
    assert settings.output.panels[1].rotation_deg == 180
    for panel, matrix in zip(settings.output.panels, truth, strict=True):
        error = error_over_panel_px(np.array(panel.homography), matrix, width_px=1920, height_px=1080)
        assert np.sqrt((error**2).mean()) < 0.1
    assert Path(told["kept_version"]).read_text() == CONFIG


def test_a_configuration_without_panels_gets_them(tmp_path: Path, vernier: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text("")
    panels("fit", "--vernier", str(vernier), "--out", str(tmp_path / "r"), "--config", str(config), "--write")
    assert len(load_settings(config).output.panels) == 3


def test_a_configuration_of_another_number_of_panels_is_left_alone(tmp_path: Path, vernier: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text('[[output.panels]]\nconnector = "HDMI-1"\n')
    with pytest.raises(InputError, match=r"output\.panels"):
        panels("fit", "--vernier", str(vernier), "--out", str(tmp_path / "r"), "--config", str(config), "--write")
    assert config.read_text() == '[[output.panels]]\nconnector = "HDMI-1"\n'
    assert not (tmp_path / "r").exists()


def test_the_registration_is_written_with_its_uncertainty(tmp_path: Path, vernier: Path) -> None:
    told = panels("fit", "--vernier", str(vernier), "--out", str(tmp_path / "r"))
    written = json.loads((tmp_path / "r" / "registration.json").read_text())
    assert written["reference"] == told["reference"] == 1
    assert 0.03 < written["sigma_px"] < 0.08
    for panel in written["panels"]:
        assert (panel["setting_sigma_px"] > 0) == (panel["panel"] != 1)
    assert "data:image/png" in (tmp_path / "r" / "index.html").read_text()
    assert len(load_settings(tmp_path / "r" / "panels.toml").output.panels) == 3


def test_a_setting_that_was_missed_is_named(tmp_path: Path, vernier: Path) -> None:
    taken = read_settings(vernier, STACK)
    lines = vernier.read_text().splitlines()
    lines[8] = ",".join([*lines[8].split(",")[:-1], str(taken[7].panel_px[1] + 5)])
    vernier.write_text("\n".join(lines) + "\n")
    told = panels("fit", "--vernier", str(vernier), "--out", str(tmp_path / "r"))
    assert any(warning.startswith("setting 8 ") for warning in told["warnings"])


def test_too_few_settings_are_refused_with_the_file(tmp_path: Path, vernier: Path) -> None:
    vernier.write_text("\n".join(vernier.read_text().splitlines()[:4]) + "\n")
    with pytest.raises(InputError, match=r"vernier\.csv: panel"):
        panels("fit", "--vernier", str(vernier), "--out", str(tmp_path / "r"))


def test_vernier_charts_are_drawn_for_every_pair(tmp_path: Path) -> None:
    told = panels("charts", "--out", str(tmp_path / "v"), "--eye", "0.5", "0", "0.02")
    assert told["files"] == [f"vernier-1-{p}-layer-{n}.png" for p, n in ((0, 1), (0, 0), (2, 1), (2, 2))]
    for name in told["files"]:
        picture = read_image(tmp_path / "v" / name)
        assert picture.shape == (1080, 1920, 3)
        assert 0.001 < (picture > 128).mean() < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_a_simulated_stack_is_recovered_to_a_tenth_of_a_pixel(tmp_path: Path, seed: int) -> None:
    told = panels("simulate", "--out", str(tmp_path / "s"), "--model", "", "--seed", str(seed))
    assert max(told["error_rms_px"]) < 0.1
    assert min(told["misaligned_rms_px"][::2]) > 0.5
    assert json.loads((tmp_path / "s" / "simulation.json").read_text()) == told


@pytest.mark.parametrize(
    "options",
    [
        ["fit", "--vernier", "none.csv", "--out", "r"],
        ["fit", "--vernier", "none.csv", "--out", "r", "--write"],
        ["charts", "--out", "r", "--eye", "0.01", "0", "0"],
        ["charts", "--out", "r", "--eye", "nan", "0", "0"],
        ["charts", "--out", "r", "--reference", "7"],
        ["grey", "--out", "lut.csv"],
        ["grey", "--out", "lut.csv", "--series", "none.csv"],
        ["cost", "--out", "r", "--left", "a.png"],
        ["simulate", "--out", "r", "--noise-px", "-1"],
    ],
)
def test_wrong_requests_are_refused_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        panels(*options)
    assert list(tmp_path.iterdir()) == []
