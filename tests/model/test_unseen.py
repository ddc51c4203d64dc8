"""Pictures that end within the panels: what they do not show takes nothing from what they show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.config import ModelSettings
from runtime.evaluation.displayed import displayed
from runtime.model import still
from runtime.model.predictor import SHIPPED, load_predictor
from runtime.model.unseen import Shown, extrapolate_border, is_whole, shown_of
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import U8
from tests.model.scenes import card_scene, eyes

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 96, 54)
WHOLE = (slice(0, 54), slice(0, 96))


@settings(max_examples=80, deadline=None)
@given(
    distance_m=st.floats(0.08, 3.0),
    side_m=st.floats(-1.0, 1.0),
    up_m=st.floats(-0.6, 0.6),
    fov_deg=st.floats(3.0, 150.0),
    rows=st.tuples(st.integers(0, 20), st.integers(21, 54)),
    columns=st.tuples(st.integers(0, 40), st.integers(41, 96)),
    margin_px=st.sampled_from([0.0, 2.5]),
)
def test_shown_is_what_lies_before_the_eye_and_within_the_picture(
    distance_m: float,
    side_m: float,
    up_m: float,
    fov_deg: float,
    rows: tuple[int, int],
    columns: tuple[int, int],
    margin_px: float,
) -> None:
    eye_m = np.array([distance_m, side_m, up_m])
    matrix = image_from_raster(image_from_stack(eye_m, width_px=160, height_px=90, fov_deg=fov_deg), STACK.panel(1))
    window = {"rows": slice(*rows), "columns": slice(*columns)}
    found = _inside(shown_of(matrix, size=(160, 90), margin_px=margin_px, **window), *columns)
    v, u = np.mgrid[window["rows"], window["columns"]] + 0.5
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
    sides = np.stack([w, x + margin_px * w, y + margin_px * w, (160 + margin_px) * w - x, (90 + margin_px) * w - y])
    nearest = sides.min(axis=0)
    slack = 1e-9 * np.abs(matrix).max() * 200  # a pixel on the very edge may count or not
    assert found[nearest > slack].all() and not found[nearest < -slack].any()


def _inside(shown: Shown, left: int, right: int) -> Any:
    u = np.arange(left, right)
    return (u >= shown.first[:, None]) & (u < shown.last[:, None])


def noise(seed: int) -> U8:
    return np.random.default_rng(seed).integers(0, 256, (54, 96, 4)).astype(np.uint8)


def runs(begin: int, end: int, first: int, last: int) -> Shown:
    """Columns first to last of rows begin to end."""
    found = Shown(np.zeros(54, np.int64), np.zeros(54, np.int64))
    found.first[begin:end], found.last[begin:end] = first, last
    return found


CASES = {
    "both end": (runs(4, 50, 10, 90), runs(0, 54, 0, 70)),
    "one within the other": (runs(0, 54, 10, 90), runs(20, 30, 30, 40)),
    "nowhere both": (runs(0, 54, 5, 30), runs(0, 54, 50, 90)),
    "in other rows": (runs(0, 20, 5, 30), runs(30, 40, 50, 90)),
    "one shows nothing": (runs(0, 54, 5, 30), runs(0, 0, 0, 0)),
    "neither shows anything": (runs(0, 0, 0, 0), runs(0, 0, 0, 0)),
    "both whole": (runs(0, 54, 0, 96), runs(0, 54, 0, 96)),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_shown_stays_and_beside_it_both_eyes_see_the_same(case: str) -> None:
    shown = CASES[case]
    images = [noise(1), noise(2)]
    before = [image.copy() for image in images]
    extrapolate_border(images, shown, rows=WHOLE[0], columns=WHOLE[1])
    masks = [_inside(one, 0, 96) for one in shown]
    for image, was, mask in zip(images, before, masks, strict=True):
        assert (image[mask] == was[mask]).all()
    between = case in {"nowhere both", "in other rows"}  # two pictures' edges there
    elsewhere = ~(masks[0] & masks[1])
    if between:
        elsewhere = masks[0] ^ masks[1]
    if masks[0].any() or masks[1].any():
        assert (images[0][elsewhere] == images[1][elsewhere]).all()
    else:
        assert all((image == was).all() for image, was in zip(images, before, strict=True))


def test_what_lies_beside_a_window_is_left_alone() -> None:
    rows, columns = slice(3, 51), slice(4, 92)
    shown = [Shown(*(np.where(one.any, np.clip(run, 4, 92), 0)[rows] for run in one)) for one in CASES["both end"]]
    images = [noise(1), noise(2)]
    extrapolate_border(images, shown, rows=rows, columns=columns)
    beside = np.ones((54, 96), bool)
    beside[rows, columns] = False
    assert (images[0][beside] == noise(1)[beside]).all()


@pytest.mark.parametrize("name", SHIPPED)
def test_eyes_whose_pictures_end_within_the_panels_see_more(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
    pair, fov_deg = eyes(0.45, 0.1), 30.0
    wide = [card_scene(eye) for eye in pair]  # 40 degrees
    height, width = (round(size * np.tan(np.radians(fov_deg / 2)) / np.tan(np.radians(20))) for size in (270, 480))
    top, left = (270 - height) // 2, (480 - width) // 2
    pictures = [np.ascontiguousarray(image[top : top + height, left : left + width]) for image in wide]
    fov_deg = float(np.degrees(2 * np.arctan(np.tan(np.radians(20)) * width / 480)))
    found = []
    for made_up in (True, False):
        if not made_up:
            monkeypatch.setattr(still, "extrapolate_border", lambda *_, **__: None)
        predictor = load_predictor(name, stack, ModelSettings(threads=1))
        layers = still.solve_still(*pictures, eyes_m=pair, fov_deg=fov_deg, predictor=predictor).layers
        predictor.close()
        found.append(displayed(layers, pictures, stack, eyes_m=pair, fov_deg=fov_deg, similarity=False).quality.psnr_db)
    assert found[0] > found[1] + 0.05


def test_pictures_that_show_every_pixel_are_whole() -> None:
    assert is_whole(runs(0, 54, 0, 96), slice(0, 96)) and not is_whole(runs(0, 54, 0, 95), slice(0, 96))
