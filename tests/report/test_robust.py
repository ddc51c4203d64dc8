"""Random pairs of the design range: drawn right, kept, and judged by the stated bar."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from model_export.data import random_place
from model_export.scene import Plane, draw, random_scene, view
from model_export.stills import filling_fov_deg, random_still
from runtime.commands.bench import app
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.report import robust
from runtime.report.pairs import StillPair
from runtime.support.cache import digest, user_cache

SIZE = {"width_px": 96, "height_px": 54}


def small(number: int) -> StillPair:
    return random_still(3, number, **SIZE)


def test_an_eyes_picture_is_the_panel_raster_seen_through_its_projection() -> None:
    size = {"width_px": 320, "height_px": 180}
    random = np.random.default_rng(5)
    stack, eyes = random_place(random, **size)
    scene = random_scene(random, stack, eyes.mean(axis=0))
    fov_deg = filling_fov_deg(stack, eyes[0])
    panel = draw(scene, eyes[0], stack.panel(1))
    image = view(scene, eyes[0], **size, fov_deg=fov_deg)
    matrix = image_from_raster(image_from_stack(eyes[0], **size, fov_deg=fov_deg), stack.panel(1))
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    warped = cv2.warpPerspective(
        image, np.linalg.inv(shift) @ matrix @ shift, (320, 180), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    )
    inside = cv2.warpPerspective(
        np.full((180, 320), 255, np.uint8),
        np.linalg.inv(shift) @ matrix @ shift,
        (320, 180),
        flags=cv2.WARP_INVERSE_MAP,
    )
    difference = np.abs(warped.astype(float) - panel)[inside == 255]
    assert inside.mean() > 100
    assert difference.mean() < 12  # two samplings of sharp edges
    moved = np.abs(np.roll(warped, 2, axis=1).astype(float) - panel)[inside == 255]
    assert moved.mean() > 1.5 * difference.mean()


def test_what_lies_behind_the_eye_is_not_seen() -> None:
    red = np.zeros((8, 8, 4), np.uint8)
    red[...] = (255, 0, 0, 255)
    # A wall beside the eye: it begins far before it and ends as far behind it.
    wall = Plane(red, np.array([-2.0, 0.3, 0.5]), np.array([4.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    image = view((wall,), np.array([0.6, 0.0, 0.0]), width_px=64, height_px=36, fov_deg=90.0)
    assert (image[18, 50:, 0] > 200).all() and (image[18, :32] == 0).all()


def test_a_pair_follows_from_seed_and_number_alone() -> None:
    one, again, other = small(4), small(4), small(5)
    assert np.array_equal(one.images, again.images) and np.array_equal(one.eyes_m, again.eyes_m)
    assert not np.array_equal(one.images, other.images)


def test_pairs_are_kept_and_a_cut_off_file_is_made_anew(tmp_path: Path) -> None:
    made: list[int] = []

    def make(number: int) -> StillPair:
        made.append(number)
        return small(number)

    def run() -> list[robust.Outcome]:
        return robust.outcomes(make, range(2), models=["fast"], cache=tmp_path)

    first = run()
    assert made == [0, 1]
    second = run()
    assert made == [0, 1]
    for a, b in zip(first, second, strict=True):
        assert a.models == b.models and a.reference == b.reference
        assert np.array_equal(a.eyes_m, b.eyes_m) and a.stack == b.stack and a.fov_deg == b.fov_deg
    (tmp_path / "1.npz").write_bytes((tmp_path / "1.npz").read_bytes()[:-200])
    run()
    assert made == [0, 1, 1]


@pytest.mark.parametrize(
    ("model_db", "reference_db", "fails"),
    [(27.9, 32.1, True), (27.9, 31.9, False), (28.1, 50.0, False), (float("nan"), 20.0, True)],
)
def test_the_bar(model_db: float, reference_db: float, fails: bool) -> None:
    stack = PanelStack(0.5, 0.3, (-0.1, 0.0, 0.1), 2, 2)
    outcome = robust.Outcome(
        7, stack, np.ones((2, 3)), 40.0, robust.Shown(reference_db, 0), {"m": robust.Shown(model_db, 0)}
    )
    assert outcome.fails("m") is fails
    verdict = robust.verdict([outcome], "m")
    assert verdict.failing == ([7] if fails else [])
    assert verdict.refused == int(np.isnan(model_db))


def test_the_command_leaves_a_record_and_a_picture_and_names_who_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.commands.bench.ROBUST_SIZE", SIZE)
    arguments = ["robust", "--pairs", "3", "--model", "fast", "--cache", str(tmp_path / "kept"), "--json"]
    passed = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out")])
    record: dict[str, Any] = json.loads(passed.stdout)
    assert json.loads((tmp_path / "out" / "robust.json").read_text())["models"] == record["models"]
    assert (tmp_path / "out" / "robust.png").read_bytes().startswith(b"\x89PNG")
    assert passed.exit_code == (1 if record["models"][0]["failing"] else 0)
    monkeypatch.setattr(robust, "POOR_DB", 99.0)
    monkeypatch.setattr(robust, "REACHED_DB", 1.0)
    failed = CliRunner().invoke(app, arguments)
    assert failed.exit_code == 1
    assert json.loads(failed.stdout)["models"][0]["failing"] == [0, 1, 2]


def test_kept_files_lie_where_the_user_keeps_such_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache("pairs") == tmp_path / "phasestack" / "pairs"
    source = tmp_path / "a.py"
    source.write_text("one")
    before = digest([source], 0)
    assert digest([source], 1) != before
    source.write_text("two")
    assert digest([source], 0) != before
