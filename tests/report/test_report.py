"""`phasestack report`: refuses bad input before it measures, and leaves a page, pictures and JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.report import report
from runtime.errors import InputError
from tests.report.test_pairs import case_folder


def command(*arguments: str):
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


@pytest.mark.slow
def test_the_whole_report_is_made_in_one_run(tmp_path: Path) -> None:
    done = command("--quick", "--focal", "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "report.json").read_text())
    names = {method["name"] for method in record["methods"]}
    assert {"fast", "balanced", "best", "SART-3", "CG-10", "filter-1", "mean of targets"} <= names
    for method in record["methods"]:
        assert method["psnr_db_off_eye"].keys() == {"2mm", "4mm", "6mm"}
    page = (tmp_path / "index.html").read_text()
    pictures = list(tmp_path.glob("*.png"))
    assert len(pictures) == page.count("data:image/png;base64,") >= 10
    assert record["machine"]["processor"] in page
