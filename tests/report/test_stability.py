"""`phasestack stability`: enough cases, all of them pass, and a case can fail."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.stability import stability
from runtime.errors import InputError
from runtime.report.stability import poses, suite
from runtime.report.stability.page import heat_map, row, spare_digits, stability_page
from runtime.report.stability.trial import Answer, Case, Trial, refusal, settle

FIELDS = {"name", "stage", "condition", "forward_error", "backward_error", "behaviour", "tolerance", "passed"}


def command(*arguments: str):
    app = typer.Typer()
    app.command()(stability)
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("stability")
    done = command("--out", str(out), "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), out


def test_there_are_at_least_120_cases_over_six_stages_and_all_pass(record: tuple[dict, Path]) -> None:
    cases = record[0]["cases"]
    assert len(cases) >= 120
    assert len({case["stage"] for case in cases}) >= 6
    assert [case["name"] for case in cases if not case["passed"]] == []
    assert len({(case["stage"], case["name"]) for case in cases}) == len(cases), "a name is used twice"


def test_every_case_states_what_the_design_asks_for(record: tuple[dict, Path]) -> None:
    for case in record[0]["cases"]:
        assert case.keys() >= FIELDS
        assert case["behaviour"] in {"answers", "warns", "refuses"}
        if case["behaviour"] != "refuses":
            assert case["forward_error"] <= case["tolerance"]


def test_json_plots_and_page_lie_in_the_folder(record: tuple[dict, Path]) -> None:
    found, out = record
    assert json.loads((out / "stability.json").read_text())["cases"] == found["cases"]
    assert (out / "heat-map.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "index.html").read_text()
    assert found["machine"]["processor"] in page
    assert "http" not in page.replace("http-equiv", ""), "the page must need nothing from elsewhere"


def test_a_failing_case_makes_the_command_exit_with_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose that is wrong by a millionth: the command, on the poses alone, with one defect put into the optics."""
    true_pose = poses.stack_from_eye

    def bent(eye: object) -> np.ndarray:
        pose = true_pose(eye)  # type: ignore[arg-type]
        pose[0, 0] += 1e-6
        return pose

    monkeypatch.setattr(poses, "stack_from_eye", bent)
    monkeypatch.setattr(suite, "every_trial", lambda fit, check, full: poses.trials())
    done = command("--out", str(tmp_path))
    assert done.exit_code == 1
    assert "FAILS eye pose" in done.output
    cases = json.loads((tmp_path / "stability.json").read_text())["cases"]
    assert any(case["passed"] for case in cases), "what does not use the bent pose still passes"


def answer(forward: float, tolerance: float = 1e-9, *, warned: bool = False) -> Trial:
    return Trial("stage", "name", lambda: Answer(forward, tolerance, warned=warned))


def test_an_error_within_its_tolerance_passes_and_one_beyond_fails() -> None:
    assert settle(answer(1e-10)).passed
    assert not settle(answer(1e-8)).passed


def test_nan_fails() -> None:
    assert not settle(answer(math.nan)).passed


def test_an_unexpected_warning_fails_and_an_expected_one_passes() -> None:
    warned = Trial("stage", "name", lambda: Answer(0.0, 1.0, warned=True), expected="warns")
    assert not settle(answer(0.0, warned=True)).passed
    assert settle(warned).passed and settle(warned).behaviour == "warns"


def test_only_the_codes_own_errors_count_as_a_refusal() -> None:
    def refuses() -> None:
        raise InputError("file", "field", "is wrong")

    def breaks() -> None:
        raise IndexError("out of bounds")

    assert settle(refusal("stage", "name", refuses)).passed
    broken = settle(refusal("stage", "name", breaks))
    assert not broken.passed and "IndexError" in broken.note
    assert not settle(refusal("stage", "name", lambda: None)).passed, "it answered where it must refuse"
    assert not settle(Trial("stage", "name", refuses)).passed, "it refused where it must answer"


def test_spare_digits_count_decades_below_the_tolerance() -> None:
    assert spare_digits(settle(answer(1e-12))) == pytest.approx(3.0)
    assert spare_digits(settle(answer(1e-6))) == pytest.approx(-3.0)


def test_a_page_of_failures_says_so_first() -> None:
    cases: list[Case] = [settle(answer(1e-8)), settle(answer(1e-12))]
    page = stability_page(cases, machine={"seed": "0"}, seconds=1.0, command="phasestack stability")
    assert page.lead.startswith("1 of 2")
    assert "FAILS" in row(cases[0])[1]
    assert heat_map(cases).png.startswith(b"\x89PNG")


def test_without_mpmath_the_command_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['mpmath'] = None\n"
        "from runtime.commands.stability import stability\n"
        "from runtime.errors import MissingPart\n"
        "try: stability(out=None, full=False, as_json=False)\n"
        "except MissingPart as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install phasestack[test]" in done.stdout
