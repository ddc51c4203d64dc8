"""`phasestack report`: refuses bad input before it measures, shows what there is as it comes, leaves page and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.report import report
from runtime.errors import InputError
from runtime.model.predictor import model_path
from runtime.report.assemble import whole_report
from tests.report.test_pairs import case_folder


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


def test_a_model_that_does_not_fit_one_of_the_cases_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    """It was, after minutes, when its turn came."""
    (tmp_path / "cases").mkdir()
    case_folder(tmp_path / "cases", panels={"width_m": 0.5, "height_m": 0.3, "x_m": [-0.05, 0.05]}, off=None)
    done = command(
        "--out", str(tmp_path / "out"), "--pairs", str(tmp_path / "cases"), "--model", str(model_path("fast"))
    )
    assert isinstance(done.exception, InputError) and "panels" in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_report_that_is_stopped_is_a_page_with_what_was_measured(tmp_path: Path) -> None:
    (tmp_path / "cases").mkdir()
    case_folder(tmp_path / "cases")

    def stop_after_two(what: str) -> None:
        if "fast" in what:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        whole_report(tmp_path / "out", pairs=tmp_path / "cases", progress=stop_after_two)
    record = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [method["name"] for method in record["methods"]] == ["balanced"]
    assert record["complete"] is False and record["methods"][0]["light_db"]["1"] > 10
    page = (tmp_path / "out" / "index.html").read_text()
    assert "Not finished" in page and page.count("data:image/png;base64,") == 1


@pytest.mark.slow
def test_the_whole_report_is_made_in_one_run(tmp_path: Path) -> None:
    done = command("--quick", "--focal", "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["complete"] is True
    assert {"fast", "balanced", "best", "SART-1", "SART-3", "SART-10"} == {m["name"] for m in record["methods"]}
    for method in record["methods"]:
        assert method["psnr_db_off_eye"].keys() == {"2mm", "4mm", "6mm"}
        assert method["light_db"]["0"] > method["light_db"]["1"] > method["light_db"]["2"]
    assert {one["motion"] for one in record["moving"]} == {"still", "lean", "walk", "stop-and-go"}
    assert len(record["focal"]["cards"]) == 3
    page = (tmp_path / "index.html").read_text()
    assert len(list(tmp_path.glob("*.png"))) == page.count("data:image/png;base64,") == 3
    assert "27.46" in page and page.count("here, 1 pair(s)") == 3
    assert record["machine"]["processor"] in page and "Not finished" not in page
