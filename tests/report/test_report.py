"""`phasestack report`: refuses bad input before it measures, and leaves a page, pictures and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.report import _variants, report
from runtime.errors import FatalError, InputError
from runtime.optics.stack import PanelStack
from runtime.report.frontier import measure, pareto
from runtime.report.methods import Method
from runtime.report.pairs import Painter, eyes_at
from tests.report.test_pairs import case_folder

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)


def command(*arguments: str) -> Any:
    app = typer.Typer()
    app.command()(report)
    return CliRunner().invoke(app, list(arguments))


def test_mistakes_are_told_before_anything_is_measured_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "cases").mkdir()
    case_folder(tmp_path / "cases", fov=500)
    (tmp_path / "bad.onnx").write_bytes(b"no model")
    for arguments in (
        ("--pairs", str(tmp_path / "nowhere")),
        ("--pairs", str(tmp_path / "cases")),
        ("--model", str(tmp_path / "bad.onnx")),
    ):
        done = command("--out", str(tmp_path / "out"), *arguments)
        assert isinstance(done.exception, InputError), done.output
        assert str(tmp_path) in str(done.exception)
        assert not (tmp_path / "out").exists()


def test_without_torch_nothing_is_made_to_compare_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert _variants(64, 64) == []


def test_what_cannot_be_made_to_compare_with_is_left_out_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def apart(make: object, path: Path, **_: object) -> None:
        if "eyereal" in path.name:
            raise FatalError("the measuring process ended with -9")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"made")

    monkeypatch.setattr("runtime.report.worker.apart", apart)
    assert [m.name for m in _variants(64, 64)] == ["fast fp16", "balanced fp16", "best fp16"]
    assert "eyereal int8 is left out: the measuring process ended with -9" in capsys.readouterr().err


@pytest.mark.slow
def test_what_is_made_to_compare_with_is_measured_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    methods = _variants(STACK.width_px, STACK.height_px)
    assert [m.name for m in methods] == ["eyereal", "eyereal int8", "fast fp16", "balanced fp16", "best fp16"]
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.onnx")}
    assert _variants(STACK.width_px, STACK.height_px) == methods
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.onnx")} == files and len(files) == 5
    with Painter("demo", STACK) as painter:
        pairs = [painter.pair(name, eyes_at(distance_m=0.6), STACK, off_mm=()) for name in ("one", "two")]
    shipped = Method("balanced", "network", "balanced")
    results = {r.name: r for r in measure([*methods, shipped], pairs, threads=1)}
    assert [results[m.name].precision for m in methods] == ["fp32", "int8", "fp16", "fp16", "fp16"]
    assert len(results["eyereal"].pairs) == 1 and not results["eyereal"].trained
    assert results["eyereal"].multiply_adds > 20 * results["balanced"].multiply_adds
    assert results["balanced fp16"].psnr_db == pytest.approx(results["balanced"].psnr_db, abs=0.2)
    assert {r.name for r in pareto(list(results.values()))}.isdisjoint({"eyereal", "eyereal int8"})


@pytest.mark.slow
def test_the_whole_report_is_made_in_one_run(tmp_path: Path) -> None:
    done = command("--quick", "--focal", "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "report.json").read_text())
    names = {method["name"] for method in record["methods"]}
    assert {"fast", "balanced", "best", "SART-3", "CG-10", "filter-1", "mean of targets"} <= names
    for method in record["methods"]:
        assert method["psnr_db_off_eye"].keys() == {"2mm", "4mm", "6mm"}
        assert method["expected_db"].keys() == {"1", "2"}
        if method["kind"] == "network":
            assert method["psnr_db"] > method["expected_db"]["1"] > method["expected_db"]["2"]
    assert {one["motion"] for one in record["moving"]} >= {"still", "lean", "walk", "stop-and-go"}
    assert {trade["model"] for trade in record["uncertainty"]} == {"fast", "balanced", "best"}
    page = (tmp_path / "index.html").read_text()
    pictures = list(tmp_path.glob("*.png"))
    assert len(pictures) == page.count("data:image/png;base64,") >= 10
    assert record["machine"]["processor"] in page
