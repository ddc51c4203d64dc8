"""Tests that `phasestack report` refuses bad input first, shows results early, and writes page and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import Result

from model_export.export import export_model
from runtime.commands.report import report
from runtime.errors import FatalError, InputError
from runtime.evaluation.solved import PairQuality
from runtime.model.predictor import model_path
from runtime.report import frontier, sections
from runtime.report.assemble import GrowingPage, Own, whole_report
from runtime.report.frontier import MethodResult, PairResult
from runtime.report.moving import FULL, Moving, moving_run
from runtime.report.page import Page, PageSection, Table, describe
from runtime.report.sections import frontier_section, moving_section, rising
from runtime.support.artifacts import write_png
from tests.calls import invoked
from tests.report.test_pairs import case_folder


def command(*arguments: str) -> Result:
    return invoked(report, *arguments)


def test_mistakes_are_told_before_anything_is_measured_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "cases").mkdir()
    case_folder(tmp_path / "cases", fov=500)
    (tmp_path / "two").mkdir()
    case_folder(tmp_path / "two", panels={"width_m": 0.5, "height_m": 0.3, "x_m": [-0.05, 0.05]}, off=None)
    (tmp_path / "bad.onnx").write_bytes(b"no model")
    for arguments in (
        ("--pairs", str(tmp_path / "nowhere")),
        ("--pairs", str(tmp_path / "cases")),
        ("--model", str(tmp_path / "bad.onnx")),
        ("--pairs", str(tmp_path / "two"), "--model", str(model_path("fast"))),
    ):
        done = command("--out", str(tmp_path / "out"), *arguments)
        assert isinstance(done.exception, InputError), done.output
        assert str(tmp_path) in str(done.exception) or "panels" in str(done.exception)
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
    assert "This report is not finished" in page and page.count("data:image/png;base64,") == 1


def own_cases(folder: Path) -> Path:
    """Two cases with three panels and one with two, and `theirs`: layers for all of them."""
    for name, x_m in (("a", [-0.05, 0.0, 0.05]), ("b", [-0.05, 0.0, 0.05]), ("c", [0.0, 0.05])):
        case_folder(folder, panels={"width_m": 0.5, "height_m": 0.3, "x_m": x_m}, off=None)
        (folder / "case.json").rename(folder / f"{name}.json")
        for n in range(len(x_m)):
            write_png(folder / "theirs" / name / f"layer-{n}.png", np.full((18, 32, 3), 85, np.uint8))
    (folder / "theirs" / "times.json").write_text('{"a": 11, "b": 12.5, "c": 13}')
    return folder


@pytest.mark.slow
def test_cases_are_grouped_by_stack_and_another_solver_s_layers_join_them(tmp_path: Path) -> None:
    cases, started = own_cases(tmp_path / "cases"), set()

    def stop_before_the_models(what: str) -> None:
        started.add(what)
        if "balanced" in what and "2 panels" in what:
            raise KeyboardInterrupt

    own = Own(only=True, layers=(cases / "theirs",))
    with pytest.raises(KeyboardInterrupt):
        whole_report(tmp_path / "out", pairs=cases, own=own, quick=True, progress=stop_before_the_models)
    record = json.loads((tmp_path / "out" / "report.json").read_text())
    theirs = [one for one in record["methods"] if one["name"] == "theirs"]
    assert [len(one["x_m"]) for one in theirs] == [3, 2] and [one["ms_p50"] for one in theirs] == [11.75, 13]
    assert {one["memory_mib"] for one in theirs} == {None}
    assert [[pair["pair"] for pair in one["pairs"]] for one in theirs] == [["a", "b"], ["c"]]
    titles = {what.partition(": ")[2].partition(":")[0] for what in started}
    assert titles == {"2 case files, 3 panels 50 mm apart, 32x18", "1 case file, 2 panels 50 mm apart, 32x18"}


def test_every_case_and_layer_is_checked_before_anything_is_measured(tmp_path: Path) -> None:
    cases = own_cases(tmp_path / "cases")
    arguments = ("--pairs", str(cases), "--only-pairs", "--layers", str(cases / "theirs"))
    for spoilt, told in (
        ((cases / "theirs" / "times.json", '{"a": 11, "b": 12.5}'), "times.json: c: must be the time in ms"),
        ((cases / "theirs" / "c" / "layer-1.png", None), "layer-1.png: cannot be read"),
    ):
        path, text = spoilt
        before = path.read_bytes()
        path.write_text(text) if text else path.unlink()
        done = command("--out", str(tmp_path / "out"), *arguments)
        assert isinstance(done.exception, InputError) and told in str(done.exception)
        path.write_bytes(before)
    assert "requires --pairs" in str(command("--only-pairs", "--out", str(tmp_path / "out")).exception)
    assert not (tmp_path / "out").exists()


def test_a_failed_measurement_is_told_and_the_report_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fails(call: Callable[..., Any], *given: Any) -> Any:
        if given[0].name == "fast":
            raise FatalError("run_method: the measuring process died unexpectedly")
        return call(*given)

    monkeypatch.setattr(frontier, "apart", fails)
    monkeypatch.setattr(frontier, "ENOUGH_S", 0.0)
    (tmp_path / "cases").mkdir()
    case_folder(tmp_path / "cases", off=None)
    done = command("--pairs", str(tmp_path / "cases"), "--only-pairs", "--quick", "--out", str(tmp_path / "out"))
    assert isinstance(done.exception, FatalError) and "1 measurement failed" in str(done.exception)
    record = json.loads((tmp_path / "out" / "report.json").read_text())
    line = "fast, case: run_method: the measuring process died unexpectedly"
    assert record["complete"] is True and record["failed"] == [line]
    assert line in done.stderr
    assert len(record["methods"]) == 5 and line in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.slow
def test_only_pairs_leaves_out_everything_built_in(tmp_path: Path) -> None:
    cases = own_cases(tmp_path / "cases")
    record = whole_report(tmp_path / "out", pairs=cases, own=Own(only=True), quick=True)
    assert record["complete"] and "moving" not in record and "methods_on_built_in_scenes" not in record
    assert {len(one["x_m"]) for one in record["methods"]} == {2, 3}


@pytest.mark.slow
def test_the_whole_report_is_made_in_one_run(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs.onnx"
    export_model("eyereal", theirs, random_init=1, options={"width": 4}, width_px=960, height_px=540)
    done = command("--quick", "--focal", "--model", str(theirs), "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["complete"] is True
    assert {"fast", "balanced", "best", "theirs", "SART-1", "SART-3", "SART-10"} == {
        m["name"] for m in record["methods"]
    }
    for method in record["methods"]:
        assert method["psnr_db_off_eye"].keys() == {"2mm", "4mm", "6mm"}
        if method["name"] != "theirs":  # random weights
            assert method["light_db"]["0"] > method["light_db"]["1"] > method["light_db"]["2"]
    assert {one["motion"] for one in record["moving"]} == {"still", "lean", "walk", "stop-and-go", "film"}
    assert len(record["focal"]["cards"]) == 3
    page = (tmp_path / "index.html").read_text()
    assert len(list(tmp_path.glob("*.png"))) == page.count("data:image/png;base64,") == 3
    assert record["machine"]["processor"] in page and "Not finished" not in page


def method(name: str, kind: str, ms: float, light: float) -> MethodResult:
    off = {"2mm": light - 6, "4mm": light - 9, "6mm": light - 11}
    dB = {"0": light + 2, "1": light, "2": light - 3}
    told = (960, 540, (-0.06, 0.0, 0.06), ms, ms * 1.3, 200.0, 81, dB, dB, light + 3, 0.97, light + 1, off)
    quality = PairQuality(dB, dB, light, 0.97, (light, light))
    pair = PairResult("a pair", (ms,), 200.0, quality, off)
    return MethodResult(name, kind, "fp32", *told, pairs=[pair])  # type: ignore[arg-type]


def report_page() -> Page:
    """The report's sections from invented measurements, for tests of the page."""
    methods = [
        method("fast", "network", 20, 36),
        method("balanced", "network", 40, 41),
        method("SART-10", "iterative", 900, 40),
    ]
    moving = [
        Moving(motion, effort, live_db, (3.0, 7.0), {effort: 5.0}, 9)
        for motion in ("still", "lean")
        for effort, live_db in (("1/1+4", 20.0), ("auto", 25.0))
    ]
    parts = [frontier_section(methods, title="Frontier", name="test"), moving_section(moving)]
    return Page("Light against run time", "A lead.", parts, describe(), "phasestack report")


def test_added_models_stand_beside_the_curves_and_every_pair_is_a_dot(monkeypatch: pytest.MonkeyPatch) -> None:
    figures: list[Any] = []
    monkeypatch.setattr(sections, "png", lambda figure: (figures.append(figure), b"")[1])
    methods = [method("fast", "network", 20, 36), method("best", "network", 90, 42), method("own", "network", 50, 30)]
    methods = [replace(one, pairs=one.pairs * 2) for one in (*methods, method("SART-3", "iterative", 300, 38))]
    sections.frontier_plot(methods, name="test")
    axes = figures[0].axes[0]
    drawn = {line.get_label(): (list(line.get_ydata()), line.get_linestyle()) for line in axes.lines}
    assert drawn == {"shipped": ([36, 42], "-"), "added": ([30], "None"), "iterative": ([38], "-")}
    assert sum(len(dots.get_offsets()) for dots in axes.collections) == 8


def test_the_page_needs_nothing_from_elsewhere() -> None:
    page = report_page()
    html = page.html()
    assert html.count("data:image/png;base64,") == len(page.figures()) == 2
    assert all(figure.png.startswith(b"\x89PNG") for figure in page.figures())
    assert not re.search(r"""(src|href)=["'](?!data:image/png|#)""", html)
    assert "http:" not in html and "https:" not in html and "@import" not in html


def test_texts_are_escaped() -> None:
    section = PageSection("<b>title</b>", ["a < b & c"], tables=[Table(["<i>"], [["<script>"]])])
    html = Page("<x>", "<y>", [section], {"<k>": "<v>"}, "a && b").html()
    for raw in ("<b>title", "<i>", "<x>", "<y>", "<k>", "<v>", "<script>\n</td>"):
        assert raw not in html
    assert "&lt;script&gt;" in html


SCALE = 0.15


def test_chosen_efforts_serve_a_moving_head_better_than_the_whole_model() -> None:
    chosen, whole, rests = (
        moving_run(motion, effort, seconds=2.5, scale=SCALE)
        for motion, effort in (("lean", None), ("lean", FULL), ("still", FULL))
    )
    assert chosen.refreshes == whole.refreshes > 3
    assert whole.view_error_mm[0] > 2 * chosen.view_error_mm[0] > 0
    assert chosen.live_db > whole.live_db + 1
    assert rests.live_db > whole.live_db + 1
    assert set(whole.efforts) == {FULL.name} and FULL.name not in chosen.efforts


def test_a_curve_goes_only_to_what_is_slower_and_better() -> None:
    places = [(40.0, 36.5), (10.0, 35.0), (30.0, 37.0), (20.0, 34.0), (90.0, 38.0)]
    assert rising(places) == [(10.0, 35.0), (30.0, 37.0), (90.0, 38.0)]


def test_times_of_a_busy_machine_are_marked(tmp_path: Path) -> None:
    page = GrowingPage(tmp_path, "phasestack report", lambda what: None)
    page.write()
    assert "machine was busy" not in (tmp_path / "index.html").read_text()
    page.record["yardsticks_ms"] += [2 * page.record["yardsticks_ms"][0]]
    page.write()
    assert "machine was busy" in (tmp_path / "index.html").read_text()
    assert len(json.loads((tmp_path / "report.json").read_text())["yardsticks_ms"]) == 2
