"""The product is what docs/contracts.md says: commands, options, files, fields, the model's contract, the error."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import typer

from calib.solution import Method
from runtime.commands.app import app
from runtime.config import Settings
from runtime.evaluation.displayed import displayed
from runtime.model.contract import Contract
from runtime.optics.stack import PanelStack
from runtime.report.frontier import MethodResult
from runtime.report.stability.trial import Case
from runtime.support.artifacts import read_image
from tests.test_cli import pair_in, phasestack, solve_arguments

PAGE = (Path(__file__).parents[1] / "docs" / "contracts.md").read_text(encoding="utf-8")


def fields_of(table: str) -> set[str]:
    """The names in the first column of the table that is headed so."""
    head = re.search(rf"^\| {re.escape(table)} \|.*\n\|[ |-]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert head, table
    return {name for row in head[1].splitlines() for name in re.findall(r"`(\w+)`", row.split(" | ")[0])}


def commands(command: Any, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """Every command by the words that call it; a group only where it does something by itself."""
    found = {path: command} if not hasattr(command, "commands") or command.invoke_without_command else {}
    for name, child in getattr(command, "commands", {}).items():
        found |= commands(child, (*path, name))
    return found


def promised() -> dict[tuple[str, ...], set[str]]:
    """Every command on the page, with its options."""
    block = re.sub(r"\n {12,}", " ", PAGE)
    calls: dict[tuple[str, ...], set[str]] = {}
    for line in re.findall(r"^    phasestack (.+)$", block, re.MULTILINE):
        words = re.match(r"(?:[a-z]+(?: |$))+", line)
        assert words, line
        name = tuple(words[0].split())
        calls[name] = calls.get(name, set()) | set(re.findall(r"--[a-z-]+", line))
    return calls


def test_every_command_that_is_promised_takes_its_options() -> None:
    known = commands(typer.main.get_command(app))
    groups = {path[:1] for path in known} | {path[:2] for path in known}
    calls = promised()
    assert len(calls) > 30
    for name, options in calls.items():
        assert name in known or name in groups, name
        if name in known:
            assert options <= {option for parameter in known[name].params for option in parameter.opts}, name


def test_every_command_is_promised() -> None:
    calls = promised()
    missing = [
        " ".join(path)
        for path in commands(typer.main.get_command(app))
        if path and path not in calls and path[:2] != ("calibrate", "panels")
    ]
    assert missing == []


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a short run leaves."""
    out = tmp_path_factory.mktemp("contract") / "out"
    result = phasestack(
        *("run", "--replay", "demo", "--headless", "--max-speed", "--frames", "12", "--scale", "0.05"),
        *("--keep-light", "6", "--out", str(out)),
    )
    assert result.returncode == 0, result.stderr
    return out


def test_a_run_leaves_every_file_and_every_field(left: Path) -> None:
    section = PAGE.partition("### What a run leaves")[2].partition("\n###")[0]
    for name in re.findall(r"`([\w-]+\.(?:png|jsonl|json))`", section):
        assert list(left.rglob(name.replace("-K", "-0"))), name
    lines = [json.loads(line) for line in (left / "frames.jsonl").read_text().splitlines()]
    assert all(fields_of("field of frames.jsonl") <= line.keys() for line in lines)
    summary = json.loads((left / "summary.json").read_text())
    assert fields_of("field of summary.json") <= summary.keys()
    assert summary["plan"] and all({"what", "why", "saves_ms", "costs_db"} <= item.keys() for item in summary["plan"])
    light = json.loads(next(left.glob("light/*/light.json")).read_text())
    assert fields_of("field of light.json") == light.keys()


def test_solve_leaves_every_field_and_the_error_is_computed_as_it_is_defined(tmp_path: Path) -> None:
    pair = pair_in(tmp_path)
    result = phasestack(*solve_arguments(pair), "--json")
    assert result.returncode == 0, result.stderr
    solved = json.loads(result.stdout)
    assert fields_of("field of solve.json") <= solved.keys()
    # The definition, ray by ray, against what the command reports.
    panels = json.loads((pair / "panels.json").read_text())
    assert panels.keys() <= fields_of("field of panels")
    stack = PanelStack(panels["width_m"], panels["height_m"], tuple(panels["x_m"]), 176, 108)
    layers = np.stack([read_image(pair / "out" / f"layer-{n}.png") for n in range(3)])
    wanted = tuple(read_image(pair / f"{side}.png") for side in ("left", "right"))
    eyes = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
    found = displayed(layers, wanted, stack, eyes_m=eyes, fov_deg=40.0)
    errors = [error_of(layers, picture, eye, stack) for picture, eye in zip(wanted, eyes, strict=True)]
    psnr_db = -10 * np.log10(np.concatenate(errors).mean())
    assert psnr_db == pytest.approx(found.quality.psnr_db, abs=0.05)
    assert psnr_db == pytest.approx(solved["psnr_db"], abs=0.05)


def error_of(layers: np.ndarray, wanted: np.ndarray, eye: np.ndarray, stack: PanelStack) -> np.ndarray:
    """Squared errors of every counted pixel and channel, from the page's own words."""
    height, width = wanted.shape[:2]
    back = eye / np.linalg.norm(eye)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    focal = width / 2 / np.tan(np.radians(40.0) / 2)
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rays = (u[..., None] - width / 2) / focal * right - (v[..., None] - height / 2) / focal * up - back
    total, counts = np.zeros(wanted.shape), np.ones(wanted.shape[:2], bool)
    for layer, x_m in zip(layers[..., :3], stack.x_m, strict=True):
        hit = eye + rays * ((x_m - eye[0]) / rays[..., :1])
        column = (hit[..., 1] / stack.width_m + 0.5) * stack.width_px
        row = (0.5 - hit[..., 2] / stack.height_m) * stack.height_px
        counts &= (column > 0.5) & (column < stack.width_px - 0.5) & (row > 0.5) & (row < stack.height_px - 0.5)
        x = np.clip(column - 0.5, 0, stack.width_px - 1.001)
        y = np.clip(row - 0.5, 0, stack.height_px - 1.001)
        i, j = x.astype(int), y.astype(int)
        a, b = (x - i)[..., None], (y - j)[..., None]
        value = layer.astype(float) / 255
        total += (value[j, i] * (1 - a) + value[j, i + 1] * a) * (1 - b)
        total += (value[j + 1, i] * (1 - a) + value[j + 1, i + 1] * a) * b
    assert counts.sum() > 1000
    squared: np.ndarray = ((np.sin(total * np.pi / 2) ** 2 - wanted / 255) ** 2)[counts]
    return squared.ravel()


def test_reports_have_every_field() -> None:
    assert fields_of("field of a method in report.json") <= {field.name for field in fields(MethodResult)}
    assert fields_of("field of a case in stability.json") <= {field.name for field in fields(Case)}


def test_a_model_s_contract_has_every_field() -> None:
    assert fields_of("field of the contract") <= Contract.model_fields.keys()


def test_every_method_and_model_is_named() -> None:
    assert set(get_args(Method)) == {name for name in get_args(Method) if f"`{name}`" in PAGE}
    assert Settings().model.name == "balanced" and "`balanced` (the default)" in PAGE


@pytest.mark.parametrize(
    ("arguments", "code"),
    [(("config",), 0), (("status", "--socket", "/nonexistent"), 1), (("demo", "--frames", "x"), 2)],
)
def test_exit_codes_are_those_of_the_page(arguments: tuple[str, ...], code: int) -> None:
    assert f"\n| {code} |" in PAGE
    result = phasestack(*arguments)
    assert result.returncode == code
    assert "Traceback" not in result.stderr
