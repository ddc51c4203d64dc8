"""Tests of folders in the format of the published data set."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.content.eyereal import is_data_set, read_folder
from runtime.content.presets import drawn_scene_from_stack
from runtime.content.procedural import ProceduralSource
from runtime.errors import InputError
from runtime.support.artifacts import write_png
from tests.content.conftest import STACK, image_view
from tests.page.rig import ROOT

LEGO = "lego_bulldozer"
LEFT, RIGHT = (6.486, -0.263, 2.004), (6.487, 0.237, 2.004)


def name_pair(folder: Path, number: int = 0, dy: float = 0.0) -> tuple[Path, Path]:
    """Empty pictures of a pair, named as in the data set (the right eye is _0 in this scene): left, right."""
    eyes = zip((LEFT, RIGHT), (1, 0), strict=True)
    left, right = (folder / f"pair{number}_x{x}_y{y + dy:.3f}_z{z}_{half}.png" for (x, y, z), half in eyes)
    for path in (left, right):
        path.touch()
    return left, right


def test_eyes_are_read_from_names_and_left_is_on_the_left(tmp_path: Path) -> None:
    left, right = name_pair(tmp_path)
    assert is_data_set(tmp_path)
    (pair,) = read_folder(tmp_path, LEGO)
    assert pair.eyes_m == pytest.approx(
        np.array([[0.781446, -0.031687, 0.241446], [0.781566, 0.028554, 0.241446]]), abs=1e-5
    )
    assert pair.paths == (left, right)


@pytest.mark.parametrize("name", ["orchids", "chair", "room_floor", "lego_entity"])
def test_pictures_look_at_the_scene_s_origin_wherever_the_display_stands(tmp_path: Path, name: str) -> None:
    """Orchids' middle panel is 0.7 m behind the scene's origin, chair's 4.5 cm before it."""
    scene_from_stack = drawn_scene_from_stack(name)
    origin = np.linalg.solve(scene_from_stack, [0.0, 0.0, 0.0, 1.0])[:3]
    assert np.linalg.norm(origin) > 0.005
    eyes = np.array([[1.5, y, 0.2] for y in (-0.03, 0.03)])
    for half, eye in enumerate(eyes):
        digital = (scene_from_stack @ np.append(eye, 1.0))[:3]
        coordinates = "_".join(f"{axis}{value:.5f}" for axis, value in zip("xyz", digital, strict=True))
        (tmp_path / f"pair0_{coordinates}_{half}.png").touch()
    (pair,) = read_folder(tmp_path, name)
    assert pair.eyes_m == pytest.approx(eyes, abs=1e-3)
    for side, eye in enumerate(pair.eyes_m):
        seen = pair.image_from_stack(side, width_px=480, height_px=270, fov_deg=40.0) @ [*origin, 1.0]
        assert seen / seen[2] == pytest.approx([240, 135, 1])
        at = origin + np.array([0.0, 0.01, 0.02])
        own = image_view(eye - origin, 480, 270).pixels_from_stack @ [*(at - origin), 1.0]  # its own coordinates
        seen = pair.image_from_stack(side, width_px=480, height_px=270, fov_deg=40.0) @ [*at, 1.0]
        assert seen / seen[2] == pytest.approx(own / own[2])


def test_half_a_pair_is_named(tmp_path: Path) -> None:
    name_pair(tmp_path)[1].unlink()
    with pytest.raises(InputError, match=r"_1.png: pair0: has _1, but needs either _0 and _1"):
        read_folder(tmp_path, LEGO)


def test_newer_data_name_the_eyes_left_and_right(tmp_path: Path) -> None:
    for path, side in zip(name_pair(tmp_path), ("left", "right"), strict=True):
        path.rename(path.with_name(f"{path.stem[:-2]}_{side}.png"))
    assert is_data_set(tmp_path)
    (pair,) = read_folder(tmp_path, LEGO)
    assert [path.name.endswith(f"_{side}.png") for path, side in zip(pair.paths, ("left", "right"), strict=True)]
    assert pair.eyes_m[0, 1] < pair.eyes_m[1, 1]


def test_a_folder_of_pairs_is_no_scene(opened: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no pictures with names such as pair0"):
        read_folder(tmp_path, LEGO)
    name_pair(tmp_path)
    with pytest.raises(InputError, match="is a folder of EyeReal's data set"):
        opened(tmp_path)


def test_a_folder_of_unseen_views_is_evaluated_with_any_model(tmp_path: Path, context: Any) -> None:
    scene = ProceduralSource("demo", stack=STACK, context=context)
    for number in range(2):
        pair = name_pair(tmp_path, number, dy=0.1 * number)
        for path, (x, y, z) in zip(pair, (LEFT, RIGHT), strict=True):
            view = image_view(np.array([x, y + 0.1 * number, z]) / 8.3, 480, 270)
            write_png(path, scene.render(view, time_ns=0))
    scene.close()
    command = [sys.executable, str(ROOT / "examples" / "unseen_views.py"), str(tmp_path), "--preset", LEGO]
    how: Any = {"env": os.environ | {"PYTHONPATH": str(ROOT)}, "capture_output": True, "text": True, "timeout": 200}
    done = subprocess.run([*command, "--model", "fast", "--model", "sart"], check=True, **how)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(one["model"], one["pairs"]) for one in told] == [("fast", 2), ("sart", 2)]
    wrong = subprocess.run([*command, "--preset", "none"], check=False, **how)
    assert wrong.returncode == 2 and "invalid choice: 'none'" in wrong.stderr.splitlines()[-1]
    assert all(one["psnr_db"] > 28 and 0.8 < one["ssim"] <= 1 and one["light_db"] > 20 for one in told)
