"""Tests that a configuration is checked for units, counts, names and files as well as form."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from runtime.commands.app import app
from runtime.config import Settings, load_settings, load_stack, with_options
from runtime.errors import InputError
from tests.calls import refusal


def loaded(folder: Path, text: str) -> Settings:
    file = folder / "phasestack.toml"
    file.write_text(text, encoding="utf-8")
    return load_settings(file)


PANEL = '[[output.panels]]\nconnector = "DP-{}"\n'


@pytest.mark.parametrize(
    ("text", "field", "said"),
    [
        ("[stack]\nwidth_m = 518.4", "stack.width_m", "for 518.4 millimetres, write 0.5184"),
        ("[stack]\nx_m = [-60, 0, 60]", "stack.x_m.0", "for -60 millimetres, write -0.06"),
        ("[stack]\nx_m = [-6, 0, 6]", "stack.x_m", "did you mean [-0.06, 0, 0.06]?"),
        ("[stack]\nx_m = [0.0, 1e-9, 0.06]", "stack.x_m", "apart, but the minimum is"),
        ("[stack]\nwidth_m = 1e-30", "stack.width_m", "out of range; use 0.005 to 20 m"),
        ("[stack]\nwidth_m = 1e308", "stack.width_m", "out of range; use 0.005 to 20 m"),
        (
            "[stack]\nheight_m = 0.5",
            "stack.height_m",
            "did you mean height_m = 0.2916? Otherwise change stack.pixel_aspect",
        ),
        ("[calibration]\nipd_m = 6.3", "calibration.ipd_m", "for 6.3 centimetres, write 0.063"),
        ("[calibration]\nviewing_m = [400, 600]", "calibration.viewing_m.0", "for 400 millimetres, write 0.4"),
        ("[tracker]\nhold_s = 500", "tracker.hold_s", "for 500 milliseconds, write 0.5"),
        (
            "[sensor]\nfixed_eyes_m = [[600, -31, 0], [600, 31, 0]]",
            "sensor.fixed_eyes_m.0.0",
            "for 600 millimetres, write 0.6",
        ),
        ("[content]\ndepth_m = [-50, 50]", "content.depth_m.0", "for -50 millimetres, write -0.05"),
        ("[loop]\nrate_hz = 60000", "loop.rate_hz", "out of range; use 1 to 1000 Hz"),
        ("[loop]\nsimulated_stage_ms = { render = -1 }", "loop.simulated_stage_ms.render", "greater than or equal"),
        ("[loop.simulated_stage_ms]\nrendr = 1", "loop.simulated_stage_ms", "not a stage: did you mean render?"),
        ("[model]\neffort = 'half'", "model.effort", "'auto' or 'full'"),
        ("[[output.panels]]\ngamma = 1e308", "output.panels.0.gamma", "out of range; use 0.1 to 10"),
        ("[[output.panels]]\nhomography = [[1, 0, 0], [0, 1, 0]]", "output.panels.0.homography.2", "required"),
        (PANEL.format(1) + PANEL.format(2), "output.panels", "must have 3 tables"),
        ("[modle]\nname = 'fast'", "modle", "did you mean model?"),
        ("[[output.panels]]\nedid_seril = 'A'", "output.panels.0.edid_seril", "did you mean edid_serial?"),
        ("[loop]\nzebra = 1", "loop.zebra", "is not a setting"),
        ("[content]\nscene = ''", "content.scene", "at least 1 character"),
        ("[model]\nname = ''", "model.name", "at least 1 character"),
        ("[loop]\nrate_hz = true", "loop.rate_hz", "valid number"),
        ("[stack]\nx_m = [-0.06, false, 0.06]", "stack.x_m.1", "valid number"),
        ("[stack]\ntilt = [[0, 0], [0, true], [0, 0]]", "stack.tilt.1.1", "valid number"),
        ("[loop]\nsimulated_stage_ms = { render = true }", "loop.simulated_stage_ms.render", "valid number"),
        ('[content]\nscale = "big"', "content.scale", "scale: Input should be a valid number"),
        ('[model]\neye_sigma_mm = "foo"', "model.eye_sigma_mm", "'auto' or a valid number"),
        ("loop = 60", "loop", "Input should be a table"),
        ("[output.panels]\nconnector = 'DP-1'", "output.panels", "Input should be a list in brackets"),
        ("[[output.panels]]\nedid_serial = 12345", "output.panels.0.edid_serial", "Input should be text in quotes"),
        ("[plan]\nenabled = 'maybe'", "plan.enabled", "Input should be true or false"),
        ("[stack]\nwidth_px = 'wide'", "stack.width_px", "Input should be a whole number"),
        ("[stack]\nx_m = [0]", "stack.x_m", "must have at least 2 items"),
        ("[stack]\nx_m = [0, 1, 2, 3, 4, 5, 6]", "stack.x_m", "must have at most 6 items"),
        (
            '[content]\nlayout = "foo"',
            "content.layout",
            "'foo' is not valid; expected: arrangement of the views: mono,",
        ),
    ],
)
def test_nonsense_is_refused_with_its_field_and_a_suggestion(tmp_path: Path, text: str, field: str, said: str) -> None:
    told = refusal(loaded, tmp_path, text)
    assert told.startswith(f"{tmp_path}/phasestack.toml: {field}: ") and said in told


@pytest.mark.parametrize("section, key", [
    ("sensor", "source"), ("calibration", "file"), ("content", "scene"), ("content", "file"), ("model", "name"),
    ("sensor", "openni2_folder"), ("sensor", "driver"), ("service", "socket"),
])  # fmt: skip
@pytest.mark.parametrize(
    ("value", "said"), [('"a\\u0000b"', "NUL"), (f'"{"x" * 5000}"', "too long"), (f'"{"y" * 300}.toml"', "too long")]
)
def test_no_name_or_path_holds_what_a_file_system_can_not(
    tmp_path: Path, section: str, key: str, value: str, said: str
) -> None:
    with pytest.raises(InputError, match=rf"phasestack\.toml: {section}\.{key}: .*{said}"):
        loaded(tmp_path, f"[{section}]\n{key} = {value}")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_file_saved_by_a_windows_editor_is_read(tmp_path: Path, encoding: str) -> None:
    file = tmp_path / "phasestack.toml"
    file.write_bytes('[content]\r\nscene = "Gärten"\r\n'.encode(encoding))
    assert load_settings(file).content.scene == "Gärten"
    file.write_bytes(file.read_bytes() + b"\xff")
    with pytest.raises(InputError, match="is not valid UTF-"):
        load_settings(file)


def test_pixels_that_are_not_square_need_to_be_told(tmp_path: Path) -> None:
    tall = "[stack]\nheight_m = 0.5\npixel_aspect = 0.583\n"
    assert loaded(tmp_path, tall).stack.height_m == 0.5
    with pytest.raises(InputError, match="pixel_aspect"):
        loaded(tmp_path, tall.replace("0.583", "1.7"))
    assert loaded(tmp_path, "[stack]\nheight_m = 0.285\n").stack.height_m == 0.285, "2% are a bezel's tolerance"


def test_a_panels_file_takes_its_pixels_from_the_pictures_whatever_their_shape(tmp_path: Path) -> None:
    """`solve` of a portrait picture on a landscape panel is the user's own wish; millimetres are not."""
    file = tmp_path / "panels.json"
    file.write_text(json.dumps({"width_m": 0.5184, "height_m": 0.2916, "x_m": [-0.06, 0, 0.06]}))
    assert load_stack(file, width_px=600, height_px=800).width_px == 600
    file.write_text(json.dumps({"width_m": 518.4, "height_m": 291.6, "x_m": [-60, 0, 60]}))
    with pytest.raises(InputError, match=r"panels\.json: width_m: .*for 518\.4 millimetres, write 0\.5184"):
        load_stack(file, width_px=600, height_px=800)


def test_what_config_prints_is_a_configuration_and_says_where_paths_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    app(["config"], standalone_mode=False)
    printed = capsys.readouterr().out
    assert printed.startswith("# Paths are relative to this file's folder.\n")
    assert loaded(tmp_path, printed) == Settings()


def test_a_path_may_begin_at_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/anna")
    assert loaded(tmp_path, '[content]\nscene = "~/films/a.mkv"\n').content.scene == "/home/anna/films/a.mkv"


def test_paths_are_relative_to_the_file_and_names_stay_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, elsewhere = tmp_path / "etc", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    text = (
        '[calibration]\nfile = "calibration.toml"\n[sensor]\nsource = "lean.mcap"\n[content]\nscene = "scenes/a.glb"\n'
        'file = "../b.ply"\n[model]\nname = "own.onnx"\n[service]\nsocket = "status.sock"\n'
        + '[[output.panels]]\nlut = "luts/0.csv"\n'
        * 3
    )
    found = loaded(folder, text)
    monkeypatch.chdir(tmp_path)
    named_from_here = load_settings(Path("etc/phasestack.toml"))
    monkeypatch.chdir(elsewhere)
    assert load_settings(Path("../etc/phasestack.toml")).model.name.endswith("etc/own.onnx")
    for settings in (found, named_from_here):
        assert settings.calibration.file == f"{folder}/calibration.toml"
        assert settings.sensor.source == f"{folder}/lean.mcap"
        assert settings.content.scene == f"{folder}/scenes/a.glb"
        assert os.path.normpath(settings.content.file) == f"{tmp_path}/b.ply"
        assert settings.model.name == f"{folder}/own.onnx"
        assert settings.service.socket == f"{folder}/status.sock"
        assert settings.output.panels[2].lut == f"{folder}/luts/0.csv"
    names = loaded(folder, '[content]\nscene = "demo"\n[model]\nname = "fast"\n[sensor]\nsource = "demo"\n')
    assert (names.content.scene, names.model.name, names.sensor.source) == ("demo", "fast", "demo")
    serial = loaded(folder, '[sensor]\ndriver = "openni2"\nsource = "1d27/0601@1/5"\n')
    assert serial.sensor.source == "1d27/0601@1/5", "a device's URI is no path"


@pytest.mark.parametrize("given", [{"scene": "s" * 5000}, {"replay": "a\0b"}, {"model": "m" * 300}])
def test_what_the_command_line_says_is_checked_like_the_file(given: dict[str, str]) -> None:
    with pytest.raises(InputError, match=f"^--{next(iter(given))}: "):
        with_options(Settings(), **given)
    assert with_options(Settings(), model="fast", headless=True).model.name == "fast"


def test_every_wrong_field_of_a_file_is_told_in_one_line(tmp_path: Path) -> None:
    text = '[stack]\nwidth_m = 518.4\n[content]\nup = "z"\n[loop]\nrate_hz = 0\nzebra = 1\n'
    parts = refusal(loaded, tmp_path, text).split("; ")
    assert parts[0].startswith(f"{tmp_path}/phasestack.toml: stack.width_m: ")
    assert any(part.startswith("content.up: is not a setting") for part in parts)
    assert any(part.startswith("loop.rate_hz: ") for part in parts) and "loop.zebra: is not a setting" in parts
