"""`phasestack bench compare`: names what got slower or worse beyond noise, and nothing else."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from runtime.commands.bench import app
from runtime.errors import InputError
from runtime.report import benchmark


def regression_file(
    *, ms: float = 100.0, scatter: float = 0.01, yardstick: float = 10.0, psnr: float = 42.0
) -> dict[str, Any]:
    size = {"width_px": 960, "height_px": 540}
    return {
        "version": 1,
        "machine": {},
        "yardstick_ms": yardstick,
        "methods": [
            {
                "name": "balanced", **size, "psnr_db": psnr, "worst_eye_psnr_db": psnr - 1, "memory_mib": 200.0,
                "psnr_db_off_eye": {"2mm": psnr - 8}, "expected_db": {"1": psnr - 3, "2": psnr - 6},
            }
        ],
        "stages": [{"name": "balanced", **size, "total_ms": ms, "total_scatter": scatter, "stage_ms": {"render": 1.0}}],
    }  # fmt: skip


def texts(old: dict[str, Any], new: dict[str, Any]) -> list[tuple[bool, str]]:
    return [(change.worse, change.text) for change in benchmark.compare(old, new)]


def test_a_file_does_not_differ_from_itself() -> None:
    assert texts(regression_file(), regression_file()) == []


def test_slower_by_more_than_the_noise_is_worse_and_faster_is_better() -> None:
    assert texts(regression_file(), regression_file(ms=110)) == []
    ((worse, text),) = texts(regression_file(), regression_file(ms=130))
    assert worse and text.startswith("1.30 times")
    ((worse, _),) = texts(regression_file(), regression_file(ms=60))
    assert not worse


def test_a_scattered_measurement_needs_a_larger_difference() -> None:
    assert texts(regression_file(scatter=0.2), regression_file(ms=130, scatter=0.2)) == []


def test_a_slower_machine_is_not_a_slower_program() -> None:
    assert texts(regression_file(), regression_file(ms=200, yardstick=20)) == []
    ((worse, _),) = texts(regression_file(), regression_file(ms=100, yardstick=5))
    assert worse


def test_lost_quality_and_memory_are_named() -> None:
    found = texts(regression_file(), regression_file(psnr=41.5))
    assert [worse for worse, _ in found] == [True] * 5
    assert found[0][1] == "-0.50 dB at the eyes"
    more = regression_file()
    more["methods"][0]["memory_mib"] = 300.0
    assert texts(regression_file(), more) == [(True, "1.50 times the memory")]


def test_what_a_pupil_sees_counts_on_its_own() -> None:
    worse = regression_file()
    worse["methods"][0]["expected_db"]["1"] -= 0.5
    assert texts(regression_file(), worse) == [(True, "-0.50 dB expected of eyes unsure by 1 mm")]
    earlier = regression_file()
    del earlier["methods"][0]["expected_db"]
    assert texts(earlier, regression_file()) == []


def test_a_model_that_is_gone_is_named_once() -> None:
    new = regression_file()
    new["methods"], new["stages"] = [], []
    assert texts(regression_file(), new) == [(True, "is missing from the new file")]


def saved(path: Path, record: dict[str, Any]) -> str:
    path.write_text(json.dumps(record))
    return str(path)


def test_the_command_exits_with_1_only_where_something_got_worse(tmp_path: Path) -> None:
    old = saved(tmp_path / "old.json", regression_file())
    worse = saved(tmp_path / "worse.json", regression_file(ms=200))
    better = saved(tmp_path / "better.json", regression_file(ms=50))
    run = CliRunner().invoke(app, ["compare", old, worse])
    assert run.exit_code == 1
    assert "worse  balanced 960x540: 2.00 times" in run.output
    assert CliRunner().invoke(app, ["compare", old, better]).exit_code == 0
    shown = CliRunner().invoke(app, ["compare", old, worse, "--json"])
    assert json.loads(shown.stdout)["worse"] == 1


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda r: r.update(version=7), "version"),
        (lambda r: r.update(yardstick_ms=0), "yardstick_ms"),
        (lambda r: r.update(methods=3), "methods"),
        (lambda r: r["stages"][0].pop("total_ms"), r"stages\[0\]\.total_ms"),
        (lambda r: r["methods"][0].update(psnr_db="x"), r"methods\[0\]\.psnr_db"),
        (lambda r: r["methods"][0].pop("name"), r"methods\[0\]\.name"),
        (lambda r: r["methods"][0].pop("psnr_db_off_eye"), r"methods\[0\]\.psnr_db_off_eye"),
        (lambda r: r["methods"][0].update(expected_db=[1]), r"methods\[0\]\.expected_db"),
        (lambda r: r["methods"][0].update(expected_db={"1": "x"}), r"methods\[0\]\.expected_db"),
    ],
)
def test_a_file_of_another_kind_is_refused_by_its_field(tmp_path: Path, change: Any, complaint: str) -> None:
    record = copy.deepcopy(regression_file())
    change(record)
    with pytest.raises(InputError, match=complaint):
        benchmark.read(Path(saved(tmp_path / "file.json", record)))


def test_the_scatter_of_a_median_shrinks_with_the_runs() -> None:
    rng = np.random.default_rng(0)
    few, many = rng.normal(100, 5, 9), rng.normal(100, 5, 900)
    assert benchmark.scatter([100.0] * 9) == 0.0
    assert benchmark.scatter(many.tolist()) < benchmark.scatter(few.tolist()) / 3
    medians = [np.median(rng.normal(100, 5, 25)) for _ in range(400)]
    assert benchmark.scatter(rng.normal(100, 5, 2500).tolist()) * 10 == pytest.approx(np.std(medians) / 100, rel=0.3)


def test_a_measurement_compares_with_itself_and_has_every_stage(tmp_path: Path) -> None:
    record = benchmark.measured(sizes=[(192, 108)])
    path = saved(tmp_path / "new.json", json.loads(json.dumps(record)))
    again = benchmark.read(Path(path))
    assert benchmark.compare(again, again) == []
    assert {entry["name"] for entry in again["stages"]} == {"fast", "balanced", "best"}
    for entry in again["stages"]:
        assert {"render", "prepare", "inference", "finish"} <= entry["stage_ms"].keys()
        assert sum(entry["stage_ms"].values()) <= 1.5 * entry["total_ms"]


def busy_file(**changes: Any) -> dict[str, Any]:
    return regression_file(ms=200) | changes


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"yardsticks_ms": [10.0, 10.4, 16.0]}, "the same work took 10.0 to 16.0 ms"),
        ({"others_cores": 1.4}, "other programs took 1.4 cores"),
    ],
)
def test_on_a_busy_machine_times_are_not_compared_and_that_is_said(
    tmp_path: Path, changes: dict[str, Any], told: str
) -> None:
    assert texts(regression_file(), busy_file(**changes)) == []
    assert texts(busy_file(**changes), regression_file()) == []
    lost = busy_file(**changes)
    lost["methods"][0]["memory_mib"] = 300.0
    assert texts(regression_file(), lost) == [(True, "1.50 times the memory")]  # what is no time is
    for name, table in (("old", regression_file()), ("new", busy_file(**changes))):
        (tmp_path / f"{name}.json").write_text(json.dumps(table))
    paths = [str(tmp_path / f"{name}.json") for name in ("old", "new")]
    done = CliRunner().invoke(app, ["compare", *paths])
    assert done.exit_code == 0 and told in done.output and "measure again" in done.output
    assert "worse" not in done.output
    done = CliRunner().invoke(app, ["compare", *paths, "--json"])
    assert json.loads(done.stdout)["times_compared"] is False


def test_a_steady_machine_is_not_called_busy() -> None:
    steady = regression_file() | {"yardsticks_ms": [10.0, 10.5, 11.0], "others_cores": 0.1}
    assert benchmark.too_busy(steady) == "" and benchmark.too_busy(regression_file()) == ""


def test_what_others_take_is_told_apart_from_our_own_work() -> None:
    import subprocess
    import sys
    import time

    ours = benchmark.OthersLoad()
    end = time.process_time() + 0.6
    while time.process_time() < end:
        pass
    mine = ours.cores()
    others = benchmark.OthersLoad()
    loop = "import time\nend = time.time() + 1.2\nwhile time.time() < end: pass"
    with subprocess.Popen([sys.executable, "-c", loop]) as other:
        time.sleep(0.9)
        theirs = others.cores()  # a child that still runs is counted as another's
        other.wait()
    assert mine is not None and theirs is not None
    assert theirs > 0.2


@pytest.mark.parametrize("value", [5, ["x"], [0.0]])
def test_yardsticks_that_are_none_are_refused(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(regression_file() | {"yardsticks_ms": value}))
    with pytest.raises(InputError, match="yardsticks_ms: must be a list of positive numbers"):
        benchmark.read(path)
