"""`phasestack plan` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.plan import plan
from runtime.errors import InputError

app = typer.Typer()
app.command()(plan)
runner = CliRunner()


def test_it_says_what_is_left_out_with_time_and_error() -> None:
    done = runner.invoke(app, ["--scene", "sparse", "--scale", "0.5", "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    items = {item["what"]: item for item in result["plan"]}
    assert result["active_fraction"] < 0.3
    assert items["inference beside the active window"]["saves_ms"] > 0
    assert abs(items["inference beside the active window"]["costs_db"]) < 0.15
    assert items["render and inference"]["costs_db"] > 0
    assert result["frame_ms"] < result["frame_ms_without"]


def test_a_budget_chooses_model_and_resolution_and_says_what_it_costs() -> None:
    done = runner.invoke(app, ["--scene", "grey", "--scale", "0.25", "--budget-ms", "0.001", "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    times = {level["label"]: level["ms"] for level in result["levels"]}
    assert result["level"] == min(times, key=lambda label: times[label])
    assert any(item["what"] == "model or resolution" for item in result["plan"])


def test_people_get_a_table() -> None:
    done = runner.invoke(app, ["--scene", "flat", "--scale", "0.25"])
    assert done.exit_code == 0, done.output
    assert "left out" in done.output


def test_a_wrong_scene_is_one_line(tmp_path: Path) -> None:
    done = runner.invoke(app, ["--scene", "nowhere"])
    assert isinstance(done.exception, InputError)
    assert "nowhere" in str(done.exception)
    done = runner.invoke(app, ["--config", str(tmp_path / "a.toml")])
    assert isinstance(done.exception, InputError)


def test_help_has_an_example() -> None:
    done = runner.invoke(app, ["--help"])
    assert "phasestack plan --scene sparse" in done.output


@pytest.mark.parametrize("name", ["lego_bulldozer", "street"])
def test_a_preset_without_its_data_shows_a_stand_in_and_says_so(name: str) -> None:
    done = runner.invoke(app, ["--scene", name, "--scale", "0.1", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["scene"].startswith(f"{name} (stand-in")
