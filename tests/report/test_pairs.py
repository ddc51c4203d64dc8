"""Tests case files, eyes and views from neighbouring positions."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.report.pairs import PairPainter, beside, eyes_at, read_pairs
from runtime.support.artifacts import write_png

EYES = [[0.7, -0.03, 0.1], [0.7, 0.03, 0.1]]


def case_folder(folder: Path, **changes: Any) -> Path:
    """A folder with one case file and its pictures."""
    rng = np.random.default_rng(0)
    for name in ("left.png", "right.png", "off.png"):
        write_png(folder / name, rng.integers(0, 256, (18, 32, 3), dtype=np.uint8))
    write_png(folder / "small.png", np.zeros((9, 16, 3), np.uint8))
    table = {
        "panels": {"width_m": 0.5, "height_m": 0.3, "x_m": [-0.05, 0.0, 0.05]},
        "eyes": EYES,
        "images": ["left.png", "right.png"],
        "fov": 40.0,
        "off": [{"mm": 2, "eye": [0.7, -0.028, 0.1], "image": "off.png"}],
    } | changes
    table = {key: value for key, value in table.items() if value is not None}
    (folder / "case.json").write_text(json.dumps(table))
    return folder


def test_a_case_file_is_read_whole(tmp_path: Path) -> None:
    (pair,) = read_pairs(case_folder(tmp_path))
    assert pair.name == "case"
    assert pair.stack == PanelStack(0.5, 0.3, (-0.05, 0.0, 0.05), 32, 18)
    np.testing.assert_array_equal(pair.eyes_m, EYES)
    assert pair.images[0].shape == (18, 32, 3)
    assert [view.mm for view in pair.off] == [2.0]


def test_other_json_files_are_ignored_and_views_off_the_eyes_optional(tmp_path: Path) -> None:
    case_folder(tmp_path, off=None)
    (tmp_path / "panels.json").write_text('{"width_m": 0.5, "height_m": 0.3, "x_m": [0.0, 0.1]}')
    (pair,) = read_pairs(tmp_path)
    assert pair.off == ()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"eyes": [[0.7, 0.0, 0.1]]}, "case.json: eyes"),
        ({"eyes": [[0.7, 0.0, "a"], [0.7, 0.1, 0.1]]}, "case.json: eyes"),
        ({"eyes": [[-0.7, 0.0, 0.1], [0.7, 0.1, 0.1]]}, "in front of every panel"),
        ({"fov": 0}, "case.json: fov"),
        ({"fov": None}, "case.json: fov"),
        ({"fovv": 30}, "case.json: fovv: is not a setting: did you mean fov?"),
        ({"off": [{"mm": 2, "eye": [1, 2, 3], "image": "off.png", "x": 1}]}, "case.json: off.0.x"),
        ({"eyes": [[0.7, -32, 0.1], [0.7, 0.03, 0.1]]}, "case.json: eyes.1: is 32.03 m from the other eye"),
        ({"fov": 1e-320}, "case.json: fov"),
        ({"eyes": [[10**320, 0.0, 0.1], [0.7, 0.1, 0.1]]}, "case.json: eyes.0.0"),
        ({"images": ["left.png"]}, "case.json: images: must be 2 files (one per eye), not 1"),
        ({"images": ["left.png", "none.png"]}, "none.png: cannot be read"),
        ({"images": ["left.png", "small.png"]}, "must have the same size"),
        ({"panels": {"width_m": 0.5, "height_m": 0.3, "x_m": [0.1, 0.0]}}, "panels: x_m"),
        ({"panels": {"width_m": -1, "height_m": 0.3, "x_m": [0.0, 0.1]}}, "panels: width_m"),
        ({"panels": 3}, "case.json: panels"),
        ({"off": [{"mm": 2}]}, "case.json: off"),
        ({"off": [{"mm": 2, "eye": [1, 2], "image": "off.png"}]}, "case.json: off.0.eye"),
        ({"off": [{"mm": 10**320, "eye": [1, 2, 3], "image": "off.png"}]}, "case.json: off.0.mm"),
        ({"off": [{"mm": 2, "eye": [1, 2, 3], "image": "small.png"}]}, "small.png: must have the same size"),
    ],
)
def test_a_mistake_in_a_case_file_is_named(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InputError, match=re.escape(complaint)):
        read_pairs(case_folder(tmp_path, **changes))


@pytest.mark.parametrize("folder", ["nowhere", "."])
def test_a_folder_without_cases_is_refused(tmp_path: Path, folder: str) -> None:
    with pytest.raises(InputError, match=r"folder|no case file"):
        read_pairs(tmp_path / folder)


def test_places_beside_an_eye_lie_in_its_image_plane() -> None:
    eye = np.array([0.6, 0.2, 0.1])
    places = np.array(beside(eye, 4.0))
    np.testing.assert_allclose(np.linalg.norm(places - eye, axis=1), 0.004)
    np.testing.assert_allclose((places - eye) @ stack_from_eye(eye)[:3, 2], 0, atol=1e-15)
    np.testing.assert_allclose(places.mean(axis=0), eye)


def test_a_built_in_pair_has_new_views_beside_its_eyes() -> None:
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54)
    with PairPainter("demo", stack) as painter:
        pair = painter.pair("demo", eyes_at(distance_m=0.6), off_mm=(2, 6))
        np.testing.assert_array_equal(painter.image(pair.off[0].eye_m, width_px=96, height_px=54), pair.off[0].image)
    assert len(pair.off) == 2 * 2 * 4
    assert (pair.images[0] != pair.images[1]).any()
    near, far = ([v.image for v in pair.off if v.mm == mm] for mm in (2, 6))

    def change(images: list[np.ndarray]) -> float:
        return float(np.mean([np.abs(image.astype(float) - pair.images[0]).mean() for image in images[:4]]))

    assert 0 < change(near) < change(far)
