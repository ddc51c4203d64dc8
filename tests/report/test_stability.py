"""Tests that `phasestack stability` has enough cases, that all pass, and that a case can fail."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from typer.testing import Result

from runtime.commands.stability import stability
from runtime.errors import InputError
from runtime.report.stability import optics, suite
from runtime.report.stability.trial import Answer, Case, Trial, settle
from tests.calls import invoked

FIELDS = {"name", "stage", "condition", "forward_error", "backward_error", "behaviour", "tolerance", "passed"}


def command(*arguments: str) -> Result:
    return invoked(stability, *arguments)


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("stability")
    done = command("--out", str(out), "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), out


def test_there_are_at_least_120_cases_over_six_stages_and_all_pass(record: tuple[dict, Path]) -> None:
    cases = record[0]["cases"]
    assert len(cases) >= 120
    assert {case["stage"] for case in cases} == STAGES
    assert all(case.keys() >= FIELDS and case["behaviour"] in {"answers", "refuses"} for case in cases)
    assert [case["name"] for case in cases if not case["passed"]] == []
    assert len({(case["stage"], case["name"]) for case in cases}) == len(cases), "a name is used twice"
    assert json.loads((record[1] / "stability.json").read_text())["cases"] == cases


@pytest.mark.slow
def test_the_long_cases_pass_too(tmp_path: Path) -> None:
    """Seen: limits of cases that only --full runs were those of a model that no longer shipped."""
    done = command("--out", str(tmp_path), "--full", "--json")
    cases = json.loads(done.stdout)["cases"]
    assert {"1000000 updates of a still head", "best: panels of 3840x2160"} <= {case["name"] for case in cases}
    assert [case["name"] for case in cases if not case["passed"]] == []
    assert done.exit_code == 0


STAGES = {"eye pose", "RPU", "phase", "Jones optics", "solve", "network", "tracker", "calibration"}


def test_a_failing_case_makes_the_command_exit_with_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose that is wrong by a millionth: the command, on the poses alone, with one defect put into the optics."""
    real = optics.stack_from_eye

    def bent(eye: ArrayLike) -> np.ndarray:
        pose = real(eye)
        pose[0, 0] += 1e-6
        return pose

    monkeypatch.setattr(optics, "stack_from_eye", bent)
    monkeypatch.setattr(suite, "every_trial", lambda fits, full: optics.trials())
    done = command("--out", str(tmp_path))
    assert done.exit_code == 1
    assert "FAILS eye pose" in done.output
    cases = json.loads((tmp_path / "stability.json").read_text())["cases"]
    assert any(case["passed"] for case in cases), "what does not use the bent pose still passes"


def test_an_unusable_output_is_refused_before_any_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(suite, "every_trial", lambda fits, full: [])
    monkeypatch.setattr(suite, "run", lambda *_, **__: pytest.fail("run first"))
    assert isinstance(command("--out", str(tmp_path / "file")).exception, InputError)


def test_a_case_that_crashes_fails_by_name_and_the_others_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def crashes() -> Answer:
        raise ZeroDivisionError("somewhere deep inside")

    def trials(fits: object, full: bool) -> list[Trial]:
        good = Trial("solve", "a good one", lambda: Answer(0.0, 1.0), measure="of the target")
        bad = Trial("solve", "a bad one", crashes, measure="of the target", floor=0.0)
        return [bad, good]

    monkeypatch.setattr(suite, "every_trial", trials)
    done = command("--out", str(tmp_path))
    assert done.exit_code == 1
    assert "FAILS solve: a bad one" in done.output and "ZeroDivisionError" in done.output
    cases = {case["name"]: case for case in json.loads((tmp_path / "stability.json").read_text())["cases"]}
    assert cases["a good one"]["passed"] and not cases["a bad one"]["passed"]


def held(forward: float, limit: float | None, *, tolerance: float = 1.0, floor: float = 0.0) -> Case:
    trial = Trial("stage", "name", lambda: Answer(forward, tolerance), floor=floor)
    return settle(trial, limit=limit)


def test_a_case_is_held_to_what_was_recorded_and_five_per_cent() -> None:
    assert held(0.104, 0.1).passed
    assert not held(0.106, 0.1).passed
    assert held(0.106, 0.1, floor=0.002).passed
    assert not held(0.5, 1.0, tolerance=0.4).passed, "a record does not loosen a tolerance"
    without = held(0.0, None)
    assert not without.passed and "no limit is recorded" in without.note


def test_only_the_codes_own_errors_count_as_a_refusal() -> None:
    def refuses() -> Answer:
        raise InputError("file", "field", "is wrong")

    def breaks() -> Answer:
        raise IndexError("out of bounds")

    assert settle(Trial("stage", "name", refuses, "refuses")).passed
    broken = settle(Trial("stage", "name", breaks, "refuses"))
    assert not broken.passed and "IndexError" in broken.note
    assert not settle(Trial("stage", "name", lambda: Answer(0.0, 1.0), "refuses")).passed, "it answered"
    assert not settle(Trial("stage", "name", refuses)).passed, "it refused where it must answer"
