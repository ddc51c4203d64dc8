"""Tests that a user's mistake on the command line gives one line, exit code 2 and no files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from runtime.commands.app import app
from runtime.errors import FatalError
from runtime.support.artifacts import write_png
from runtime.support.picture_file import read_image

PANELS = {"width_m": 0.5184, "height_m": 0.2916, "x_m": [-0.06, 0.0, 0.06]}


def phasestack(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "runtime.cli", *map(str, arguments)], capture_output=True, text=True, timeout=120
    )


def refusal(*arguments: str | Path) -> str:
    """Message of a command's error; the guard turns it into one line and exit 2 (tests/test_exit_codes.py)."""
    with pytest.raises(FatalError) as told:
        app([str(argument) for argument in arguments])
    assert "\n" not in str(told.value)
    return str(told.value)


def pair_in(folder: Path) -> Path:
    """The folder, with a small stereo pair and its panels in it."""
    rng = np.random.default_rng(1)
    for name in ("left", "right"):
        coarse = rng.integers(0, 255, (12, 20, 3)).astype(np.uint8)
        write_png(folder / f"{name}.png", coarse.repeat(9, 0).repeat(9, 1)[:108, :176].copy())
    (folder / "panels.json").write_text(json.dumps(PANELS))
    return folder


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    return pair_in(tmp_path)


def solve_arguments(folder: Path, **changes: object) -> list[str]:
    values: dict[str, object] = {
        "--left": folder / "left.png",
        "--right": folder / "right.png",
        "--left-eye": (0.6, -0.03, 0.0),
        "--right-eye": (0.6, 0.03, 0.0),
        "--fov": 40,
        "--panels": folder / "panels.json",
        "--out": folder / "out",
    }
    values.update({f"--{name.replace('_', '-')}": value for name, value in changes.items()})
    arguments = ["solve"]
    for name, value in values.items():
        arguments += [name, *map(str, value)] if isinstance(value, tuple) else [name, str(value)]
    return arguments


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"left": "missing.png"}, "missing.png"),
        ({"panels": "missing.json"}, "missing.json"),
        ({"left_eye": (0.05, -0.03, 0.0)}, "--left-eye"),
        ({"left_eye": ("nan", 0, 0)}, "--left-eye"),
        ({"right_eye": (0.6, -0.03, 0.0)}, "--right-eye"),
        ({"right_eye": (0.6, -0.0251, 0.0)}, "--right-eye: is 4.9 mm from the left eye"),
        ({"left_eye": (0.061, 40.0, 0.0), "right_eye": (0.061, 40.06, 0.0)}, "--left-eye"),
        ({"left_eye": (0.6, 1e30, 0)}, "--left-eye: 1e+30 m is out of range; use -50 to 50 m"),
        (
            {"left_eye": (0.6, 0, 0), "right_eye": (0.66, 0, 0), "model": "fast"},
            "--right-eye: fast does not support these eye positions (the eyes have no horizontal separation",
        ),
        (
            {"left_eye": (50, 50, 50), "right_eye": (0.07, -50, -50), "model": "fast"},
            "--right-eye: fast does not support these eye positions (these eye positions are implausible",
        ),
        ({"fov": 180}, "--fov"),
        ({"fov": 1e-320}, "--fov"),
        ({"model": "quick"}, "solve: --model: 'quick'"),
        ({"model": "panels.onnx"}, "panels.onnx"),
    ],
)
def test_what_cannot_be_solved_is_one_line_and_exit_2(pair: Path, changes: dict[str, object], named: str) -> None:
    (pair / "panels.onnx").write_bytes(b"this is no model")
    paths = {"left", "panels", "model"}
    located = {k: (pair / str(v) if k in paths and "." in str(v) else v) for k, v in changes.items()}
    assert named in refusal(*solve_arguments(pair, **located))
    assert not (pair / "out").exists()


def test_eyes_in_line_with_the_displays_depth_are_served_by_sart(pair: Path) -> None:
    eyes: dict[str, object] = {"left_eye": (0.6, 0, 0), "right_eye": (0.66, 0, 0)}
    app(solve_arguments(pair, **eyes, model="sart"), standalone_mode=False)
    assert (pair / "out" / "solve.json").exists()


def test_a_decoder_s_complaint_about_a_damaged_picture_is_in_the_line(pair: Path) -> None:
    data = bytearray((pair / "left.png").read_bytes())
    data[len(data) // 2] ^= 0x5A
    (pair / "damaged.png").write_bytes(data)
    result = phasestack(*solve_arguments(pair, left=pair / "damaged.png"))
    assert result.returncode == 2
    (line,) = result.stderr.strip().splitlines()
    assert "damaged.png: cannot be decoded as an image because the file is damaged" in line


def test_a_folder_in_a_layer_s_place_is_named_and_nothing_replaced(pair: Path) -> None:
    (pair / "out" / "layer-1.png").mkdir(parents=True)
    (pair / "out" / "layer-0.png").write_text("the old one")
    assert "layer-1.png: is a folder" in refusal(*solve_arguments(pair, model="fast"))
    assert {path.name for path in (pair / "out").iterdir()} == {"layer-0.png", "layer-1.png"}
    assert (pair / "out" / "layer-0.png").read_text() == "the old one"


def test_pictures_of_different_sizes_are_refused(pair: Path) -> None:
    write_png(pair / "right.png", np.zeros((50, 60, 3), np.uint8))
    assert "right.png: size: " in refusal(*solve_arguments(pair))


@pytest.mark.parametrize(
    ("table", "field"),
    [
        ({**PANELS, "depth_m": 1}, "depth_m"),
        ({"width_m": 0.5, "height_m": 0.3}, "x_m"),
        ({**PANELS, "x_m": [0.01 * n for n in range(7)]}, "x_m: must list 2 to 6 panels"),
        ({"stack": PANELS}, "width_m: is missing; in a panels file, move it from [stack] to the top level"),
    ],
)
def test_panels_that_make_no_stack_are_refused_by_field(pair: Path, table: dict[str, object], field: str) -> None:
    (pair / "panels.json").write_text(json.dumps(table))
    assert f"panels.json: {field}" in refusal(*solve_arguments(pair))


@pytest.mark.parametrize(("frames", "says"), [(2, True), (30, False)])
def test_a_run_that_shows_no_solution_says_so(tmp_path: Path, frames: int, says: bool) -> None:
    how = ("--replay", "demo", "--headless", "--max-speed", "--scale", "0.1", "--model", "fast")
    done = phasestack("run", *how, "--frames", str(frames))
    assert done.returncode == 0 and ("no viewer was seen" in done.stdout) == says


@pytest.mark.parametrize(("name", "layout"), [("pair_sbs.png", None), ("pair.png", "cross-eyed")])
def test_one_file_that_holds_both_views_is_solved_as_two(pair: Path, name: str, layout: str | None) -> None:
    left, right = (read_image(pair / f"{side}.png") for side in ("left", "right"))
    write_png(pair / name, np.hstack([right, left] if layout else [left, right]))
    app(solve_arguments(pair, model="fast"), standalone_mode=False)
    both = json.loads((pair / "out" / "solve.json").read_text())["light_db"]["1"]
    arguments = solve_arguments(pair, model="fast", left=pair / name)
    at = arguments.index("--right")
    app(arguments[:at] + arguments[at + 2 :] + (["--layout", layout] if layout else []), standalone_mode=False)
    alone = json.loads((pair / "out" / "solve.json").read_text())["light_db"]["1"]
    assert alone == both


def test_one_view_is_refused_and_so_is_a_layout_for_two_files(pair: Path) -> None:
    arguments = solve_arguments(pair)
    at = arguments.index("--right")
    assert "left.png: layout: contains 1 view; pass --right or a different --layout" in refusal(
        *arguments[:at], *arguments[at + 2 :]
    )
    assert "solve: --layout: cannot be combined with --right" in refusal(*arguments, "--layout", "side-by-side")
    assert "--layout: layout" in refusal("run", "--replay", "demo", "--headless", "--layout", "sideways")


def test_run_shows_a_file_in_the_layout_that_it_is_given(pair: Path, tmp_path: Path) -> None:
    left, right = (read_image(pair / f"{side}.png") for side in ("left", "right"))
    write_png(pair / "pair.png", np.hstack([left, right]))
    how = ("--replay", "demo", "--headless", "--max-speed", "--scale", "0.1", "--model", "fast", "--frames", "30")
    for layout, differ in (("side-by-side", True), ("mono", False)):
        done = phasestack(
            "run", *how, "--scene", str(pair / "pair.png"), "--layout", layout, "--out", str(tmp_path / layout)
        )
        assert done.returncode == 0, done.stderr
        seen = [read_image(tmp_path / layout / f"wanted-{side}.png").astype(int) for side in ("left", "right")]
        assert (abs(seen[0] - seen[1]).mean() > 20) == differ


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "solve: --left: is required without --case"),
        (("--left", "left.png"), "solve: --panels: is required without --case"),
        (("--case", "case.json", "--left", "left.png"), "solve: --left: is part of the case file"),
        (("--case", "missing.json"), "missing.json"),
    ],
)
def test_pictures_come_from_options_or_from_a_case_file(arguments: tuple[str, ...], told: str, tmp_path: Path) -> None:
    assert told in refusal("solve", "--out", str(tmp_path / "out"), *arguments)
