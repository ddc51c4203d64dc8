"""`phasestack solve` leaves out what its pictures do not need, and says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.commands.solve import solve
from runtime.support.artifacts import write_json, write_png
from tests.calls import answered


def pictures(folder: Path, *, grey: bool) -> None:
    """A textured square that the eyes see some pixels apart, on a background that they share."""
    random = np.random.default_rng(3)
    texture = cv2.GaussianBlur(random.integers(0, 256, (60, 80, 3), np.uint8), (0, 0), 2)
    texture = np.clip((texture.astype(np.float64) - 128) * 5 + 128, 0, 255).astype(np.uint8)
    for name, shift in (("left", 3), ("right", -3)):
        picture = np.full((270, 480, 3), (90, 90, 90) if grey else (90, 120, 150), np.uint8)
        picture[100:160, 200 + shift : 280 + shift] = texture[..., :1] if grey else texture
        write_png(folder / f"{name}.png", picture)
    write_json(folder / "panels.json", {"width_m": 0.5184, "height_m": 0.2916, "x_m": [-0.06, 0.0, 0.06]})


def solved(folder: Path, *more: str, model: str = "balanced") -> dict[str, Any]:
    eyes = ["--left-eye", "0.6", "-0.031", "0", "--right-eye", "0.6", "0.031", "0"]
    files = ["--left", str(folder / "left.png"), "--right", str(folder / "right.png")]
    where = ["--panels", str(folder / "panels.json"), "--out", str(folder / "out")]
    result: dict[str, Any] = answered(solve, *files, *eyes, *where, "--model", model, *more)
    return result


@pytest.mark.parametrize("model", ["fast", "balanced", "best"])
def test_the_window_is_solved_alone_and_costs_little(tmp_path: Path, model: str) -> None:
    pictures(tmp_path, grey=False)
    planned = solved(tmp_path, model=model)
    (item,) = planned["plan"]
    assert item["what"] == "inference outside the active window"
    plain = solved(tmp_path, "--no-plan", model=model)
    assert plain["plan"] == []
    assert plain["psnr_db"] - planned["psnr_db"] < 0.8  # steps beside the window


def test_grey_pictures_are_solved_in_one_channel(tmp_path: Path) -> None:
    pictures(tmp_path, grey=True)
    assert {item["what"] for item in solved(tmp_path)["plan"]} == {
        "inference outside the active window",
        "two of three colour channels",
    }


def test_pictures_that_differ_everywhere_leave_nothing_out(tmp_path: Path) -> None:
    pictures(tmp_path, grey=False)
    random = np.random.default_rng(0)
    for name in ("left", "right"):
        write_png(tmp_path / f"{name}.png", random.integers(0, 256, (270, 480, 3), np.uint8))
    result = solved(tmp_path)
    assert result["plan"] == [] and result["steps"] == 5


def test_floats_are_the_layers_before_rounding_without_a_window(tmp_path: Path) -> None:
    pictures(tmp_path, grey=True)
    assert solved(tmp_path, "--floats")["plan"] == []
    floats, layer = np.load(tmp_path / "out/layers.npy"), cv2.imread(str(tmp_path / "out/layer-2.png"))
    assert floats.shape == (3, 270, 480, 3) and floats.dtype == np.float32
    assert layer is not None and np.abs(floats[2] * 255 - layer[..., ::-1]).max() < 0.501
