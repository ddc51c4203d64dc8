"""`phasestack plan` as a user runs it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from runtime.commands.plan import plan
from runtime.errors import InputError
from runtime.support.artifacts import read_image

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


def labels(*options: str) -> list[str]:
    done = runner.invoke(app, ["--scene", "grey", "--scale", "0.1", "--budget-ms", "0.001", "--json", *options])
    assert done.exit_code == 0, done.output
    return [level["label"] for level in json.loads(done.stdout)["levels"]]


def test_a_budget_is_planned_from_the_levels_that_the_daemon_would_choose_from(tmp_path: Path) -> None:
    assert {label.split()[0] for label in labels("--model", "sart")} == {"sart"}
    two = tmp_path / "two.toml"
    two.write_text("[stack]\nx_m = [-0.03, 0.03]\n")
    assert not {"fast", "best"} & set(labels("--config", str(two)))


@pytest.mark.parametrize("model", ["balanced", "sart"])
def test_what_can_be_chosen_is_the_ladder_of_the_running_loop(model: str) -> None:
    from runtime.config import Settings
    from runtime.plan.ladder import rungs
    from runtime.plan.levels import QualityLevel

    settings = Settings.model_validate({"model": {"name": model}})
    known = {QualityLevel(name, scale, 0.0, 0.0).label for name, scale in rungs(settings, settings.stack.stack())}
    shown = set(labels("--model", model))
    assert shown <= known, "levels that are slower and worse than another are left out"
    assert len(known) > 1


@pytest.mark.parametrize(
    ("eyes", "said"),
    [
        ("0 0 0", "not in front of the panels"),
        ("-1 0 0", "not in front of the panels"),
        ("0.06 0 0", "not in front of the panels"),
        ("nan 0 0", "is not a number"),
        ("0.6 inf 0", "is beyond 50 m"),
        ("0.061 40 0", "nothing of the display can be seen"),
        ("1e300 0 0", "is beyond 50 m"),
        ("600 0 0", "did you mean millimetres (0.6)"),
    ],
)
def test_eyes_that_see_nothing_are_one_line(eyes: str, said: str) -> None:
    done = runner.invoke(app, ["--scene", "flat", "--scale", "0.1", "--eyes", *eyes.split()])
    assert isinstance(done.exception, InputError), done.exception
    assert str(done.exception).startswith("plan: --eyes: ")
    assert said in str(done.exception)


def test_fixed_eyes_of_the_configuration_are_checked_by_their_own_name(tmp_path: Path) -> None:
    config = tmp_path / "phasestack.toml"
    config.write_text("[sensor]\nfixed_eyes_m = [[-0.6, -0.03, 0], [-0.6, 0.03, 0]]\n")
    done = runner.invoke(app, ["--config", str(config), "--scale", "0.1"])
    assert str(done.exception).startswith("sensor.fixed_eyes_m: ")


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


def test_the_survey_tells_time_and_error_with_and_without(tmp_path: Path) -> None:
    done = runner.invoke(app, ["--survey", "--quick", "--scale", "0.2", "--out", str(tmp_path / "a" / "b"), "--json"])
    assert done.exit_code == 0, done.output
    folder = tmp_path / "a" / "b"
    result = json.loads(done.stdout)
    assert json.loads((folder / "plan-survey.json").read_text(encoding="utf-8")) == result
    assert [row["name"] for row in result["scenes"]] == ["sparse", "texture", "grey", "flat", "thin", "moving"]
    rows = {row["name"]: row for row in (*result["scenes"], *result["other_sparse"])}
    assert rows["texture"]["active_fraction"] == 1.0
    assert rows["grey"]["channels"] == 1
    assert rows["flat"]["active_fraction"] == 0.0
    assert rows["sparse"]["active_fraction"] < 0.4
    assert {item["what"] for item in rows["sparse"]["left_out"]} == {"inference beside the active window"}
    for row in rows.values():
        assert row["ms_with"] > 0
        assert row["ms_with_p99"] >= row["ms_with"]
        assert row["db_without"] - row["db_with"] < 0.3  # few pixels: a tenth is asserted at half size
    sizes = {(row["width_px"], row["height_px"]) for row in result["regions"]}
    assert len(sizes) == 2
    for size in sizes:
        active = [row["active_px"] for row in result["regions"] if (row["width_px"], row["height_px"]) == size]
        assert active == sorted(active)
        assert active[0] < active[-1]
    for name in ("plan-scenes.png", "plan-regions.png"):
        picture = read_image(folder / name)
        assert picture.shape[0] > 300
        assert picture.std() > 10
    assert "| sparse object on white |" in (folder / "plan-survey.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--survey"], "--out"),
        (["--out", "x"], "--survey"),
        (["--survey", "--out", "x", "--scene", "demo"], "--scene"),
    ],
)
def test_the_survey_s_options_go_together(options: list[str], said: str) -> None:
    done = runner.invoke(app, options)
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)


def test_one_figure_stands_for_one_thing() -> None:
    """What reuse costs is told with the drift that it is of, and agrees with what is shown then."""
    import re

    done = runner.invoke(app, ["--scene", "sparse", "--scale", "0.2"])
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    still = float(re.search(r"solved for: ([\d.]+) dB with", text)[1])  # type: ignore[index]
    drifted = float(re.search(r"drifted by 1 mm, just before its picture is renewed: ([\d.]+) dB", text)[1])  # type: ignore[index]
    result = json.loads(runner.invoke(app, ["--scene", "sparse", "--scale", "0.2", "--json"]).stdout)
    (reuse,) = [item for item in result["plan"] if item["what"] == "render and inference"]
    assert still - drifted == pytest.approx(reuse["costs_db"], abs=0.02)
    assert result["psnr_db"] - result["psnr_db_drifted"] == pytest.approx(reuse["costs_db"], abs=0.002)


@pytest.mark.parametrize(
    ("option", "name", "told"),
    [
        ("--scene", "textures", "plan: --scene: `textures` is neither .* did you mean texture"),
        ("--scene", "nosuch", "17 presets, such as lego_bulldozer"),
        ("--model", "nosuch", "plan: --model: 'nosuch'"),
    ],
)
def test_a_name_that_nothing_has_is_told_by_its_option_and_uncut(option: str, name: str, told: str) -> None:
    error = runner.invoke(app, [option, name, "--scale", "0.05", "--json"]).exception
    assert isinstance(error, InputError) and re.search(told, str(error)) and "..." not in str(error)
