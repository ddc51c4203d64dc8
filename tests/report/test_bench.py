"""Tests that `phasestack bench compare` lists what got slower or worse by more than noise, and only that."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.commands.bench import app
from runtime.errors import InputError
from runtime.report import benchmark
from tests.calls import answered, invoked


def regression_file(
    *, ms: float = 100.0, scatter: float = 0.01, yardstick: float = 10.0, light: float = 42.0
) -> dict[str, Any]:
    return {
        "version": 2,
        "machine": {},
        "yardstick_ms": yardstick,
        "yardsticks_ms": [yardstick],
        "methods": [
            {
                "name": "balanced", "width_px": 960, "height_px": 540, "ms_p50": ms, "scatter": scatter,
                "psnr_db": light + 2, "worst_eye_psnr_db": light + 1, "memory_mib": 200.0,
                "light_db": {"0": light, "1": light - 3, "2": light - 6},
            }
        ],
    }  # fmt: skip


def texts(old: dict[str, Any], new: dict[str, Any]) -> list[tuple[bool, str]]:
    files = [benchmark.RegressionFile.model_validate(table) for table in (old, new)]
    return [(change.worse, change.text) for change in benchmark.compare(*files)]


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ({}, {}, ""),
        ({}, {"ms": 110}, ""),
        ({}, {"ms": 130}, "worse 1.30 times"),
        ({}, {"ms": 60}, "better 0.60 times"),
        ({"scatter": 0.2}, {"ms": 130, "scatter": 0.2}, ""),  # a scattered measurement needs a larger difference
        ({}, {"ms": 200, "yardstick": 20}, ""),  # a slower machine is not a slower program
        ({}, {"ms": 100, "yardstick": 5}, "worse 2.00 times"),
    ],
)
def test_a_change_beyond_noise_is_worse_if_slower_and_better_if_faster(old: Any, new: Any, found: str) -> None:
    told = texts(regression_file(**old), regression_file(**new))
    assert len(told) == bool(found)
    assert " ".join(f"{'worse' if worse else 'better'} {text}" for worse, text in told).startswith(found)


def test_lost_light_and_memory_are_named() -> None:
    found = texts(regression_file(), regression_file(light=41.5))
    assert [worse for worse, _ in found] == [True] * 5
    assert "-0.50 dB of light PSNR at a tracking error of 1 mm" in [text for _, text in found]
    alone = regression_file()
    alone["methods"][0]["light_db"]["1"] -= 0.5
    assert texts(regression_file(), alone) == [(True, "-0.50 dB of light PSNR at a tracking error of 1 mm")]
    more = regression_file()
    more["methods"][0]["memory_mib"] = 300.0
    assert texts(regression_file(), more) == [(True, "1.50 times the memory")]


def saved(path: Path, record: dict[str, Any]) -> str:
    path.write_text(json.dumps(record))
    return str(path)


def test_the_command_exits_with_1_only_where_something_got_worse(tmp_path: Path) -> None:
    old = saved(tmp_path / "old.json", regression_file())
    worse = saved(tmp_path / "worse.json", regression_file(ms=200))
    better = saved(tmp_path / "better.json", regression_file(ms=50))
    run = invoked(app, "compare", old, worse)
    assert run.exit_code == 1
    assert "worse  balanced 960x540: 2.00 times" in run.output
    assert invoked(app, "compare", old, better).exit_code == 0
    assert json.loads(invoked(app, "compare", old, worse, "--json").stdout)["worse"] == 1


@pytest.mark.parametrize("out", ["", "file/bench.json"])
def test_an_unusable_output_is_refused_before_the_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(benchmark, "measured", lambda **_: pytest.fail("measured first"))
    answer = invoked(app, "--out", tmp_path / out)
    assert isinstance(answer.exception, InputError)


def test_the_measurement_is_written_where_it_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "measured", lambda **_: regression_file())
    out = tmp_path / "new" / "bench.json"
    assert invoked(app, "--out", out, "--json").exit_code == 0
    assert json.loads(out.read_text()) == regression_file() and [*out.parent.iterdir()] == [out]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda r: r.update(version=7), "version"),
        (lambda r: r.update(yardstick_ms=0), "yardstick_ms"),
        (lambda r: r.update(methods=3), "methods"),
        (lambda r: r.update(yardsticks_ms=["x"]), "yardsticks_ms"),
        (lambda r: r["methods"][0].update(psnr_db="x"), r"methods\.0\.psnr_db"),
        (lambda r: r["methods"][0].pop("name"), r"methods\.0\.name"),
        (lambda r: r["methods"][0].update(light_db={"1": "x"}), r"methods\.0\.light_db"),
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


def test_a_measurement_compares_with_itself(tmp_path: Path) -> None:
    record = benchmark.measured(models=["fast"], sizes=[(192, 108)])
    again = benchmark.read(Path(saved(tmp_path / "new.json", json.loads(json.dumps(record)))))
    assert benchmark.compare(again, again) == []
    assert {entry.name for entry in again.methods} == {"fast"}


def test_on_a_busy_machine_times_are_not_compared_and_that_is_said(tmp_path: Path) -> None:
    quiet, busy = regression_file(), regression_file(ms=200) | {"yardsticks_ms": [10.0, 10.4, 16.0]}
    assert texts(quiet, busy) == texts(busy, quiet) == []
    paths = [saved(tmp_path / "old.json", quiet), saved(tmp_path / "new.json", busy)]
    done = invoked(app, "compare", *paths)
    assert done.exit_code == 0 and "the same work took 10.0 to 16.0 ms" in done.output
    assert "measure again" in done.output and "worse" not in done.output
    assert answered(app, "compare", *paths)["times_compared"] is False
    busy["methods"][0]["memory_mib"] = 300.0
    assert texts(quiet, busy) == [(True, "1.50 times the memory")]  # other figures are compared
