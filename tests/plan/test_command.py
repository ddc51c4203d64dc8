"""`phasestack plan` as a user runs it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from runtime.commands.plan import plan
from runtime.errors import InputError
from tests.calls import answered, invoked


def test_it_says_what_is_left_out_with_time_and_error() -> None:
    result = answered(plan, "--scene", "sparse", "--scale", 0.5)
    items = {item["what"]: item for item in result["plan"]}
    assert result["active_fraction"] < 0.3
    assert items["inference outside the active window"]["saves_ms"] > 0
    assert abs(items["inference outside the active window"]["costs_db"]) < 0.25
    assert items["render and inference"]["costs_db"] > 0
    assert result["frame_ms"] < result["frame_ms_without"]


@pytest.mark.parametrize(
    ("eyes", "said"),
    [
        ("[-0.6, -0.03, 0], [-0.6, 0.03, 0]", "not in front of the panels"),
        ("[0.061, 40, 0], [0.061, 40.06, 0]", "cannot see any part of the display"),
    ],
)
def test_fixed_eyes_that_see_nothing_are_one_line(tmp_path: Path, eyes: str, said: str) -> None:
    config = tmp_path / "phasestack.toml"
    config.write_text(f"[sensor]\nfixed_eyes_m = [{eyes}]\n")
    done = invoked(plan, "--config", config, "--scale", "0.1")
    assert str(done.exception).startswith("sensor.fixed_eyes_m: ") and said in str(done.exception)


def test_a_wrong_scene_is_one_line(tmp_path: Path) -> None:
    done = invoked(plan, "--scene", "nowhere")
    assert isinstance(done.exception, InputError)
    assert "nowhere" in str(done.exception)
    done = invoked(plan, "--config", tmp_path / "a.toml")
    assert isinstance(done.exception, InputError)


def test_what_reuse_costs_agrees_with_what_is_shown_after_the_drift() -> None:
    done = invoked(plan, "--scene", "sparse", "--scale", "0.2")
    assert done.exit_code == 0, done.output
    told = dict(line.split(maxsplit=1) for line in done.output.splitlines())
    result = answered(plan, "--scene", "sparse", "--scale", 0.2)
    (reuse,) = [item for item in result["plan"] if item["what"] == "render and inference"]
    drifted_db = float(told["psnr_db"]) - float(told["psnr_db_drifted"])
    assert drifted_db == pytest.approx(reuse["costs_db"], abs=0.02) and told["drift_mm"] == "1"
    assert result["psnr_db"] - result["psnr_db_drifted"] == pytest.approx(reuse["costs_db"], abs=0.002)


@pytest.mark.parametrize(
    ("option", "name", "told"),
    [
        ("--scene", "textures", "plan: --scene: `textures` is not a file.* did you mean texture"),
        ("--scene", "nosuch", "17 presets such as lego_bulldozer"),
        (
            "--scene",
            "street",
            "content: file: is missing; set it to the .ply file, .glb file or data-set folder of street",
        ),
        ("--model", "nosuch", "plan: --model: 'nosuch'"),
    ],
)
def test_a_name_that_nothing_has_is_told_by_its_option_and_uncut(option: str, name: str, told: str) -> None:
    error = invoked(plan, option, name, "--scale", "0.05", "--json").exception
    assert isinstance(error, InputError) and re.search(told, str(error)) and "..." not in str(error)
