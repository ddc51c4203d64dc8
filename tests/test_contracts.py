"""The product is what docs/contracts.md says: commands, options, files, fields, the model's contract, the error."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest
import typer

from calib.solution import Method
from runtime.commands.app import app
from runtime.config import Settings, with_options
from runtime.daemon.build import RunOptions
from runtime.daemon.drive import drive
from runtime.model.contract import Contract
from runtime.report.frontier import MethodResult
from runtime.report.stability.trial import Case
from tests.test_cli import pair_in, solve_arguments
from tests.test_docs import walk

PAGE = (Path(__file__).parents[1] / "docs" / "contracts.md").read_text(encoding="utf-8")


def fields_of(table: str) -> set[str]:
    """The names in the first column of the table that is headed so."""
    head = re.search(rf"^\| {re.escape(table)} \|.*\n\|[ |-]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert head, table
    return {name for row in head[1].splitlines() for name in re.findall(r"`(\w+)`", row.split(" | ")[0])}


def test_every_command_is_promised() -> None:
    """That a promised one takes its options is in tests/test_docs.py, as of every page."""
    promised = re.findall(r"^    phasestack ((?:[a-z]+(?: |$))+)", PAGE, re.MULTILINE)
    known = {" ".join(path) for path, command in walk(typer.main.get_command(app)) if not hasattr(command, "commands")}
    assert known - {name.strip() for name in promised} == set()


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a short run leaves."""
    out = tmp_path_factory.mktemp("contract") / "out"
    options = RunOptions(max_speed=True, measure=True, scale=0.05, keep_light=6, frames=12, out=out)
    drive(with_options(Settings(), replay="demo", headless=True), options)
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


def test_solve_leaves_every_file_and_every_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = pair_in(tmp_path)
    panels = json.loads((pair / "panels.json").read_text())
    assert panels.keys() <= fields_of("field of panels")
    app([*solve_arguments(pair), "--json"], standalone_mode=False)
    solved = json.loads(capsys.readouterr().out)
    assert solved == json.loads((pair / "out" / "solve.json").read_text())
    assert fields_of("field of solve.json") <= solved.keys()
    names = {path.name for path in (pair / "out").iterdir()}
    assert names >= {"layer-0.png", "layer-1.png", "layer-2.png", "seen-left.png", "seen-right.png", "solve.json"}
    assert {"contact-sheet.png", "viewer.html"} <= names and sum(solved["wall_s"].values()) > solved["total_ms"] / 1e3
    assert solved["psnr_db"] > 15
    assert solved["total_ms"] >= solved["inference_ms"] > 0


def test_reports_have_every_field() -> None:
    assert fields_of("field of a method in report.json") <= {field.name for field in fields(MethodResult)}
    assert fields_of("field of a case in stability.json") <= {field.name for field in fields(Case)}


def test_a_model_s_contract_has_every_field() -> None:
    assert fields_of("field of the contract") <= Contract.model_fields.keys()


def test_every_method_and_model_is_named() -> None:
    assert set(get_args(Method)) == {name for name in get_args(Method) if f"`{name}`" in PAGE}
    assert Settings().model.name == "balanced" and "`balanced` (the default)" in PAGE
