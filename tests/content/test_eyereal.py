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

from runtime.content.base import View
from runtime.content.eyereal import EyeRealSource, is_data_set, read_folder
from runtime.content.presets import drawn_scene_from_stack
from runtime.content.procedural import ProceduralSource
from runtime.errors import InputError
from runtime.support.artifacts import write_png
from tests.content.conftest import STACK, image_view, panel_view
from tests.page.rig import ROOT

LEGO = "lego_bulldozer"
LEFT, RIGHT = (6.486, -0.263, 2.004), (6.487, 0.237, 2.004)


def write_pair(folder: Path, context: Any, number: int = 0, dy: float = 0.0) -> None:
    """A pair as the data set names it (the right eye is _0 in this scene)."""
    scene = ProceduralSource("demo", stack=STACK, context=context)
    for side, (eye, half) in enumerate(((LEFT, 1), (RIGHT, 0))):
        x, y, z = eye[0], eye[1] + dy, eye[2]
        view = image_view(np.array([x, y, z]) / 8.3, 480, 270, side=side)
        write_png(folder / f"pair{number}_x{x:.3f}_y{y:.3f}_z{z:.3f}_{half}.png", scene.render(view, time_ns=0))
    scene.close()


def test_eyes_are_read_from_names_and_left_is_on_the_left(tmp_path: Path, context: Any) -> None:
    write_pair(tmp_path, context)
    assert is_data_set(tmp_path)
    (pair,) = read_folder(tmp_path, LEGO)
    assert pair.eyes_m == pytest.approx(
        np.array([[0.781446, -0.031687, 0.241446], [0.781566, 0.028554, 0.241446]]), abs=1e-5
    )
    assert pair.paths[0].name.endswith("_1.png")


@pytest.mark.parametrize("name", ["orchids", "chair", "room_floor", "lego_entity"])
def test_pictures_look_at_the_scene_s_origin_wherever_the_display_stands(
    tmp_path: Path, context: Any, name: str
) -> None:
    """Orchids' middle panel is 0.7 m behind the scene's origin, chair's 4.5 cm before it."""
    scene_from_stack = drawn_scene_from_stack(name)
    origin = np.linalg.solve(scene_from_stack, [0.0, 0.0, 0.0, 1.0])[:3]
    assert np.linalg.norm(origin) > 0.005
    scene = ProceduralSource("demo", stack=STACK, context=context)
    for half, y in enumerate((-0.03, 0.03)):
        eye = np.array([1.5, y, 0.2])
        digital = (scene_from_stack @ np.append(eye, 1.0))[:3]
        own = image_view(eye - origin, 480, 270)  # of an eye that looks at the origin of its coordinates
        shifted = own.pixels_from_stack @ np.block([[np.eye(3), -origin[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        picture = scene.render(View(eye, half, shifted, 480, 270), time_ns=0)
        coordinates = "_".join(f"{axis}{value:.5f}" for axis, value in zip("xyz", digital, strict=True))
        write_png(tmp_path / f"pair0_{coordinates}_{half}.png", picture)
    (pair,) = read_folder(tmp_path, name)
    assert pair.eyes_m == pytest.approx(np.array([[1.5, -0.03, 0.2], [1.5, 0.03, 0.2]]), abs=1e-3)
    source = EyeRealSource((pair,), fov_deg=40, background=(1, 1, 1), name="lego")
    for side in (0, 1):
        view = panel_view(pair.eyes_m[side], STACK.panel(1), side=side)
        wanted, given = scene.render(view, time_ns=0).astype(int), source.render(view, time_ns=0).astype(int)
        inside = given[..., 3] == 255
        assert inside.mean() > 0.5
        right, shifted = (np.abs(one - given)[inside][:, :3].mean() for one in (wanted, np.roll(wanted, 4, axis=1)))
        assert right < 0.6 * shifted


def test_the_nearest_pair_is_shown(tmp_path: Path, context: Any) -> None:
    for number, dy in enumerate((0.0, 1.0, -1.0)):
        write_pair(tmp_path, context, number, dy)
    pairs = read_folder(tmp_path, LEGO)
    several = EyeRealSource(pairs, fov_deg=40, background=(1, 1, 1), name="lego")
    for index, pair in enumerate(pairs):
        alone = EyeRealSource((pairs[index],), fov_deg=40, background=(1, 1, 1), name="lego")
        for side in (0, 1):
            view = panel_view(pair.eyes_m[side] + [0.01, 0.01, 0.0], STACK.panel(1), side=side)
            assert (several.render(view, time_ns=0) == alone.render(view, time_ns=0)).all()


def test_half_a_pair_is_named(tmp_path: Path, context: Any) -> None:
    write_pair(tmp_path, context)
    next(tmp_path.glob("*_0.png")).unlink()
    with pytest.raises(InputError, match=r"_1.png: pair0: has _1, but needs either _0 and _1"):
        read_folder(tmp_path, LEGO)


def test_newer_data_name_the_eyes_left_and_right(tmp_path: Path, context: Any) -> None:
    write_pair(tmp_path, context)
    for half, side in (("1", "left"), ("0", "right")):
        path = next(tmp_path.glob(f"*_{half}.png"))
        path.rename(path.with_name(path.name.replace(f"_{half}.png", f"_{side}.png")))
    assert is_data_set(tmp_path)
    (pair,) = read_folder(tmp_path, LEGO)
    assert [path.name.endswith(f"_{side}.png") for path, side in zip(pair.paths, ("left", "right"), strict=True)]
    assert pair.eyes_m[0, 1] < pair.eyes_m[1, 1]


def test_a_folder_without_pairs_and_a_truncated_picture_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no pictures with names such as pair0"):
        read_folder(tmp_path, LEGO)
    for half, y in ((0, 0.2), (1, -0.2)):
        (tmp_path / f"pair0_x6.0_y{y}_z2.0_{half}.jpg").write_bytes(b"\xff\xd8\xff broken")
    with pytest.raises(InputError, match="cannot be decoded as an image"):
        EyeRealSource(read_folder(tmp_path, LEGO), fov_deg=40, background=(1, 1, 1), name="lego")


def test_a_folder_is_read_as_the_preset_in_its_name(opened: Any, tmp_path: Path, context: Any) -> None:
    named, other = tmp_path / "lego_bulldozer-test", tmp_path / "from-the-net"
    named.mkdir()
    write_pair(named, context)
    source = opened(named)
    known = EyeRealSource(read_folder(named, LEGO), fov_deg=40, background=(1, 1, 1), name="lego")
    view = panel_view((0.78, 0.0, 0.24), STACK.panel(1))
    assert source.info.name == "lego_bulldozer"
    assert (source.render(view, time_ns=0) == known.render(view, time_ns=0)).all()
    named.rename(other)
    with pytest.raises(
        InputError, match=r"from-the-net: name: does not contain the name of a preset; set content.scene"
    ):
        opened(other)


def test_a_folder_of_unseen_views_is_evaluated_with_any_model(tmp_path: Path, context: Any) -> None:
    for number in range(2):
        write_pair(tmp_path, context, number, dy=0.1 * number)
    command = [sys.executable, str(ROOT / "examples" / "unseen_views.py"), str(tmp_path), "--preset", LEGO]
    how: Any = {"env": os.environ | {"PYTHONPATH": str(ROOT)}, "capture_output": True, "text": True, "timeout": 200}
    done = subprocess.run([*command, "--model", "fast", "--model", "sart"], check=True, **how)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(one["model"], one["pairs"]) for one in told] == [("fast", 2), ("sart", 2)]
    wrong = subprocess.run([*command, "--preset", "none"], check=False, **how)
    assert wrong.returncode == 2 and "invalid choice: 'none'" in wrong.stderr.splitlines()[-1]
    assert all(one["psnr_db"] > 28 and 0.8 < one["ssim"] <= 1 and one["light_db"] > 20 for one in told)
