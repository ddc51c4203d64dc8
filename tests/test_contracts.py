"""Tests that commands, options, files and fields are as docs/contracts.md says."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import onnx
import pytest
import typer
from onnx import TensorProto, helper, numpy_helper

from calib.solution import Method
from runtime.commands.app import app
from runtime.config import Settings, with_options
from runtime.daemon.build import RunOptions
from runtime.daemon.drive import drive
from runtime.model.contract import METADATA_KEY, Contract
from runtime.report.frontier import MethodResult
from runtime.report.pairs import read_pairs
from runtime.report.stability.trial import Case
from runtime.report.tolerance import IMPERFECTIONS, Cost
from runtime.report.tolerance_page import cost_entry
from runtime.support.artifacts import write_png
from tests.eyes.scene import eileen
from tests.test_cli import pair_in, solve_arguments
from tests.test_docs import PAGES, blocks_of, walk

PAGE = (Path(__file__).parents[1] / "docs" / "contracts.md").read_text(encoding="utf-8")


def fields_of(table: str) -> set[str]:
    """The names in the first column of the table that is headed so."""
    head = re.search(rf"^\| {re.escape(table)} \|.*\n\|[ |-]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert head, table
    return {name for row in head[1].splitlines() for name in re.findall(r"`(\w+)`", row.split(" | ")[0])}


def test_every_command_is_promised() -> None:
    """The options of promised commands are tested in tests/test_docs.py."""
    promised = re.findall(r"^    phasestack ((?:[a-z]+(?: |$))+)", PAGE, re.MULTILINE)
    known = {" ".join(path) for path, command in walk(typer.main.get_command(app)) if not hasattr(command, "commands")}
    assert known - {name.strip() for name in promised} == set()


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short run."""
    out = tmp_path_factory.mktemp("contract") / "out"
    options = RunOptions(max_speed=True, measure=True, scale=0.05, keep_light=6, frames=12, out=out)
    drive(with_options(Settings(), replay="demo", headless=True), options)
    return out


def test_a_run_leaves_every_file_and_every_field(left: Path) -> None:
    section = PAGE.partition("### What a run leaves")[2].partition("\n###")[0]
    for name in re.findall(r"`([\w-]+\.(?:png|jsonl|json))`", section):
        assert list(left.rglob(name.replace("-K", "-0"))), name
    lines = [json.loads(line) for line in (left / "frames.jsonl").read_text().splitlines()]
    assert all(fields_of("field of frames.jsonl") == line.keys() for line in lines)
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
    cost = Cost(IMPERFECTIONS[0], [30.0] * len(IMPERFECTIONS[0].sizes))
    assert fields_of("field of a cost in tolerance.json") <= cost_entry(cost, 30.0).keys()
    assert fields_of("field of a case in stability.json") <= {field.name for field in fields(Case)}


def shown(first: str) -> dict[str, Any]:
    """The one JSON object that a page shows and that begins with this field."""
    found = [json.loads(block) for page in PAGES for block in blocks_of(page) if block.startswith("{")]
    (one,) = (example for example in found if next(iter(example)) == first)
    assert isinstance(one, dict) and len(found) == 3  # what pages show: each has its test below
    return one


def test_the_contract_that_is_shown_is_taken_with_its_model(tmp_path: Path) -> None:
    contract = shown("version")
    assert contract.keys() <= fields_of("field of the contract") <= Contract.model_fields.keys()
    weights = numpy_helper.from_array(np.full((9, 6, 1, 1), 0.1, np.float32), "weights")
    ports = [helper.make_tensor_value_info(contract[way][0]["name"], TensorProto.FLOAT, [1, channels, "h", "w"])
             for way, channels in (("inputs", 6), ("outputs", 9))]  # fmt: skip
    node = helper.make_node("Conv", [ports[0].name, "weights"], [ports[1].name])
    graph = helper.make_graph([node], "mine", ports[:1], ports[1:], [weights])
    model = helper.make_model(graph, ir_version=10, opset_imports=[helper.make_opsetid("", 17)])
    helper.set_model_props(model, {METADATA_KEY: json.dumps(contract)})
    onnx.save(model, str(tmp_path / "mine.onnx"))
    assert not app(["validate", str(tmp_path / "mine.onnx")], standalone_mode=False)


def test_the_case_that_is_shown_is_read(tmp_path: Path) -> None:
    case = shown("panels")
    for name in (*case["images"], *(view["image"] for view in case["off"])):
        write_png(tmp_path / name, np.zeros((18, 32, 3), np.uint8))
    (tmp_path / "case.json").write_text(json.dumps(case))
    assert case.keys() == {"panels", "eyes", "images", "fov", "off"} and len(read_pairs(tmp_path)) == 1


def test_eyes_answers_with_what_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_png(tmp_path / "a.png", eileen().picture)
    app(["eyes", str(tmp_path / "a.png"), "--json"], standalone_mode=False)
    (found,) = json.loads(capsys.readouterr().out)["pictures"]
    (entry,) = shown("pictures")["pictures"]
    assert {name: type(found[name]) for name in entry} == {name: type(value) for name, value in entry.items()}
    assert np.shape(found["eyes_px"]) == np.shape(entry["eyes_px"]) and found["eyes_px"][0] > found["eyes_px"][1]


def test_every_method_and_model_is_named() -> None:
    assert set(get_args(Method)) == {name for name in get_args(Method) if f"`{name}`" in PAGE}
    assert Settings().model.name == "balanced" and "`balanced` (the default)" in PAGE
