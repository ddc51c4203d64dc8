"""What a still picture's own rays lack is found exactly, brought back, and makes what the eyes see better."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

import runtime.model.back_projection
from runtime.config import Settings
from runtime.evaluation.displayed import displayed, expected_db
from runtime.model.back_projection import add_what_is_lacked, gain_for
from runtime.model.compiled.sight import PARTS, lack_at_rays
from runtime.model.loops import Loops
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.pyramid_level import CENTRE, PyramidLevel
from runtime.model.still import solve_still
from runtime.optics.retina import layer_from_image, seen_by
from runtime.optics.stack import PanelStack, Tilt
from runtime.optics.views import image_from_stack
from runtime.plan.predictors import planned_predictor
from runtime.plan.reduced import ReducedPredictor
from runtime.records import F64, U8
from tests.model.scenes import FOV_DEG, card_scene, eyes

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
TILTED = replace(STACK, tilt=Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), (1.0, 0.1, -0.05)))
POSES = {
    "straight": eyes(0.6),
    "beside and above": eyes(0.7, 0.2, 0.1),
    "near": eyes(0.2, -0.05),
    "rolled": eyes(0.6, roll_deg=20),
    "above each other": np.array([[0.6, 0.0, -0.031], [0.6, 0.0, 0.031]]),
}
HALF = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
WHOLE = {"rows": slice(0, 270), "columns": slice(0, 480)}


def noise(*shape: int, seed: int = 1) -> U8:
    """Smooth to a few pixels, opaque."""
    fine = np.random.default_rng(seed).integers(0, 256, (*shape, 4)).astype(np.uint8)
    images = fine.reshape(-1, *shape[-2:], 4)
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 1.0) for image in images]).reshape(fine.shape)
    smooth[..., 3] = 255
    return np.asarray(smooth, np.uint8)


def cards(pair: F64, **size: int) -> list[U8]:
    return [card_scene(eye, **size) for eye in pair]


def unrefined(predictor: Predictor, pictures: list[U8], pair: F64, monkeypatch: pytest.MonkeyPatch, **how: Any) -> U8:
    with monkeypatch.context() as without:
        without.setattr(type(predictor), "refines", False)
        return solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor, **how).layers.copy()


def shown_db(layers: U8, pictures: list[U8], pair: F64, stack: PanelStack = STACK) -> tuple[float, float]:
    """Exact, and for a pupil."""
    seen = displayed(layers, pictures, stack, eyes_m=pair, fov_deg=FOV_DEG, similarity=False)
    pupil_db = expected_db(seen, layers, stack, eyes_m=pair, fov_deg=FOV_DEG)["1"]
    assert pupil_db is not None
    return seen.quality.psnr_db, pupil_db


@pytest.mark.parametrize("stack", [STACK, TILTED], ids=["even", "tilted"])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("size", [(480, 270), (301, 170)], ids=["panels' pixels", "another size"])
@pytest.mark.parametrize(("least", "most"), [(0.0, 255.0), (1.0, 12.0)])
def test_rays_lack_what_the_eye_does_not_see(
    stack: PanelStack, pose: str, size: tuple[int, int], least: float, most: float
) -> None:
    width, height = size
    layers, picture = noise(3, 270, 480), noise(height, width, seed=2)
    for eye_m in POSES[pose]:
        projection = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=FOV_DEG)
        between = [layer_from_image(stack, n, eye_m, projection) for n in range(3)]
        matrices = np.stack([np.linalg.inv(HALF) @ matrix @ HALF for matrix in between])
        matrices /= (matrices[:, 2] @ (width / 2, height / 2, 1.0))[:, None, None]
        lack = lack_at_rays(layers, picture, matrices, least=least, most=most)
        seen = seen_by(eye_m, layers, stack, fov_deg=FOV_DEG, width_px=width, height_px=height)
        wanted = np.where(seen.mask[..., None], picture[..., :3] - 255 * seen.image.astype(np.float64), 0)
        wanted = np.clip(wanted - np.clip(wanted, -least, least), -most, most)
        assert seen.mask.any()
        # A ray on the very edge may count for one and not for the other.
        assert (np.abs(lack[..., :3] / PARTS - wanted) <= 0.125).mean() >= 0.9999
        assert (lack[..., 3] == 0).all()


@pytest.mark.parametrize("pose", POSES)
def test_without_compiled_loops_the_same_is_added(pose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    layers, picture, eye_m = noise(3, 270, 480), noise(200, 400, seed=2), POSES[pose][0]
    start = noise(270, 480, seed=3)
    where = {"rows": slice(16, 250), "columns": slice(24, 470)}
    added = []
    for plain in (False, True):
        if plain:
            monkeypatch.setattr(runtime.model.back_projection, "inner_loops", lambda: Loops(PyramidLevel, ""))
        image = start.copy()
        add_what_is_lacked(
            image, STACK.panel(CENTRE), layers, picture, STACK, eye_m=eye_m, fov_deg=FOV_DEG, gain=0.7, **where
        )
        added.append(image.astype(int))
        beside = np.ones(image.shape[:2], bool)
        beside[where["rows"], where["columns"]] = False
        assert (image[beside] == start[beside]).all()
        assert (image[..., 3] == 255).all()
    assert (np.abs(added[0] - start) > 3).mean() > 0.05
    # At the edge of what rays cross one of them may count a ray that the other does not.
    assert (np.abs(added[0] - added[1]) <= 1).mean() >= 0.999


def test_sure_eyes_have_all_of_it_added_and_unsure_ones_less() -> None:
    pair = POSES["straight"]
    shares = [gain_for(STACK, pair, eye_sigma_mm=sigma_mm) for sigma_mm in (0.0, 1.0, 3.0, 10.0, 50.0)]
    assert shares[0] == 1
    assert all(after < before for before, after in pairwise(shares)) and shares[-1] > 0


@pytest.mark.parametrize("pose", ["straight", "beside and above", "rolled", "above each other"])
def test_a_still_picture_is_seen_better_exactly_and_by_a_pupil(pose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pair, predictor = POSES[pose], load_predictor("best", STACK)
    pictures = cards(pair)
    for sigma_mm, least_db in ((0.0, (0.3, -0.05)), (1.0, (0.2, 0.05))):
        before = shown_db(unrefined(predictor, pictures, pair, monkeypatch, eye_sigma_mm=sigma_mm), pictures, pair)
        solved = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor, eye_sigma_mm=sigma_mm)
        after = shown_db(solved.layers, pictures, pair)
        assert (np.subtract(after, before) >= least_db).all(), (sigma_mm, before, after)
    predictor.close()


def test_rays_between_those_that_were_looked_along_see_it_better_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else it would suit the rays that are measured, and no eye."""
    pair, predictor = POSES["straight"], load_predictor("best", STACK)
    pictures, finer = cards(pair), cards(pair, width_px=960, height_px=540)
    made = [
        unrefined(predictor, pictures, pair, monkeypatch, eye_sigma_mm=0.0),
        solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor, eye_sigma_mm=0.0).layers.copy(),
    ]
    errors = []
    for layers in made:
        seen = [seen_by(eye, layers, STACK, fov_deg=FOV_DEG, width_px=960, height_px=540) for eye in pair]
        off = [(r.image - picture / 255.0)[r.mask] for r, picture in zip(seen, finer, strict=True)]
        errors.append(np.mean(np.concatenate(off) ** 2))
    assert errors[1] < errors[0]
    predictor.close()


def test_a_window_is_refined_like_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """A card on white: the plan solves the part in which the eyes' pictures differ."""
    pair, settings = POSES["straight"], Settings.model_validate({"model": {"name": "best"}})
    predictor = planned_predictor(settings, STACK)
    pictures = []
    for picture in cards(pair):
        only = np.full_like(picture, 255)
        only[100:180, 180:300] = picture[100:180, 180:300]
        pictures.append(only)
    before = shown_db(unrefined(predictor, pictures, pair, monkeypatch), pictures, pair)
    solved = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor)
    assert 0 < predictor.active_fraction < 0.7  # type: ignore[attr-defined]
    after = shown_db(solved.layers, pictures, pair)
    assert after[0] > before[0] + 0.3 and after[1] > before[1]
    assert set(solved.stage_ms) == {"prepare", "inference", "finish"}
    white = np.full_like(pictures[0], 255)
    same = solve_still(white, white, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor)
    assert not predictor.refines and same.stage_ms["inference"] == 0  # nothing was solved that could be refined
    predictor.close()


def test_fewer_pixels_are_refined_too(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, small = POSES["straight"], replace(STACK, width_px=240, height_px=135)
    predictor = ReducedPredictor(load_predictor("best", small), STACK)
    pictures = cards(pair, width_px=240, height_px=135)
    assert predictor.refines
    before = unrefined(predictor, pictures, pair, monkeypatch)
    after = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor).layers
    wide = [cv2.resize(picture, (480, 270), interpolation=cv2.INTER_CUBIC) for picture in pictures]
    assert shown_db(after, wide, pair)[0] > shown_db(before, wide, pair)[0]
    predictor.close()


@pytest.mark.parametrize("width_px", [120, 1600])
def test_a_picture_much_coarser_or_finer_than_the_panels_is_solved_once(
    width_px: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair, predictor = POSES["straight"], load_predictor("best", STACK)
    pictures = cards(pair, width_px=width_px, height_px=width_px * 9 // 16)
    monkeypatch.setattr(type(predictor), "refine", lambda *_, **__: pytest.fail("looked along its rays"))
    solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor)
    predictor.close()


@pytest.mark.parametrize("name", ["fast", "balanced", "sart"])
def test_other_models_have_no_steps_to_do_again(name: str) -> None:
    predictor = load_predictor(name, STACK)
    assert not predictor.refines
    predictor.close()


@pytest.mark.parametrize("name", ["fast", "best"])
def test_a_picture_of_one_column_is_shown(name: str) -> None:
    """Compiled loops read two pixels of a row at once."""
    pair, predictor = POSES["straight"], load_predictor(name, STACK)
    grey = np.full((1, 1, 3), 90, np.uint8)
    layers = solve_still(grey, grey, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor).layers
    seen = seen_by(pair[0], layers, STACK, fov_deg=FOV_DEG)
    assert np.abs(255 * seen.image[seen.mask] - 90).max() <= 3
    predictor.close()
