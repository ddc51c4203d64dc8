"""Models end to end: what the eyes see, whatever the pose and the stack."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from runtime import kernels
from runtime.config import ModelSettings
from runtime.errors import EyesNotServed, ModelFailure
from runtime.model.geometry import visible_boxes
from runtime.model.job import drawn_job
from runtime.model.predictor import load_predictor
from runtime.model.sart import SartPredictor
from runtime.model.session import ModelSession
from runtime.model.still import solve_still
from runtime.optics.carried import expected_psnrs_db
from runtime.optics.light import ONE_RAY
from runtime.optics.retina import layers_from_image
from runtime.optics.sampling import projected
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.report.pairs import eyes_at
from tests.model.scenes import FOV_DEG, STACK, card_scene, displayed, eyes

POSES = {
    "in front": eyes(0.6),
    "near": eyes(0.3),
    "far": eyes(2.0),
    "aside": eyes(0.5, 0.6),
    "above": eyes(0.6, 0.1, 0.35),
    "head tilted": eyes(0.6, 0.05, 0.1, roll_deg=20),
    "head turned": np.array([[0.56, -0.028, 0.0], [0.59, 0.025, 0.0]]),
    "narrow eyes": eyes(0.6, separation_m=0.015),
}


GREY = np.full((270, 480, 4), 128, np.uint8)


def solved(name: str, pair: np.ndarray, stack: PanelStack = STACK) -> np.ndarray:
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    pictures = [card_scene(eye, **size) for eye in pair]
    predictor = load_predictor(name, stack, ModelSettings(threads=1))
    try:
        return solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor).layers.copy()
    finally:
        predictor.close()


@pytest.mark.parametrize("pose", POSES)
def test_balanced_shows_both_eyes_what_three_sweeps_of_sart_do_or_better(pose: str) -> None:
    pair = POSES[pose]
    pictures = [card_scene(eye) for eye in pair]
    reference = SartPredictor(STACK, iterations=3)
    theirs = displayed(solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=reference).layers, pair, STACK)
    ours = displayed(solved("balanced", pair), pair, STACK)
    assert ours.psnr_db >= theirs.psnr_db - 0.3
    assert abs(ours.eye_psnr_db[0] - ours.eye_psnr_db[1]) < 3.0


@pytest.mark.parametrize("pose", ["in front", "aside", "head tilted"])
def test_larger_models_show_more(pose: str) -> None:
    fast, balanced, best = (displayed(solved(name, POSES[pose]), POSES[pose], STACK).psnr_db for name in
                            ("fast", "balanced", "best"))  # fmt: skip
    assert fast < balanced < best


@pytest.mark.parametrize("gap_m", [0.005, 0.03, 0.15])
def test_any_even_spacing_is_served(gap_m: float) -> None:
    stack = PanelStack(0.5184, 0.2916, (-gap_m, 0.0, gap_m), 480, 270)
    shown = displayed(solved("balanced", eyes(0.7), stack), eyes(0.7), stack)
    assert shown.psnr_db > 20


@pytest.mark.parametrize("x_m", [(-0.03, 0.03), (-0.08, 0.0, 0.03), (-0.09, -0.03, 0.03, 0.09)])
def test_other_stacks_are_served_from_even_panels_and_the_name_says_so(x_m: tuple[float, ...]) -> None:
    stack = PanelStack(0.5184, 0.2916, x_m, 240, 135)
    predictor = load_predictor("balanced", stack)
    assert predictor.facts.name.startswith("balanced (without its network")
    layers = solved("balanced", eyes(0.6), stack)
    assert layers.shape == (len(x_m), 135, 240, 4)
    assert displayed(layers, eyes(0.6), stack).psnr_db > 18


def test_equal_pictures_on_the_centre_panel_leave_the_outer_panels_even() -> None:
    predictor = load_predictor("balanced", STACK, ModelSettings(threads=1))
    picture = np.full((270, 480, 4), 255, np.uint8)
    picture[..., :3] = np.random.default_rng(0).integers(0, 255, (270, 480, 3))
    layers = predictor.solve(drawn_job([picture, picture], eyes(0.6), STACK)).layers
    assert np.abs(layers[[0, 2], ..., :3].astype(int) - 128).max() <= 1


def test_what_was_seen_before_leaves_nothing_behind() -> None:
    """A head comes to the middle, lies down and sits up again."""
    predictor = load_predictor("balanced", STACK, ModelSettings(threads=1))
    for pair in (POSES["aside"], eyes(0.6), eyes(0.6, roll_deg=90), eyes(0.6)):
        pictures = [card_scene(eye) for eye in pair]
        layers = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor).layers
        assert (layers == solved("balanced", pair)).all()


LEVEL = {
    "upright": eyes(0.6),
    "ahead": eyes_at(distance_m=0.7, angle_deg=0),
    "far aside": eyes_at(distance_m=1.25, angle_deg=47),
}


@cache
def level_db(pose: str) -> float:
    return displayed(solved("balanced", LEVEL[pose]), LEVEL[pose], STACK).psnr_db


@pytest.mark.parametrize(
    ("pair", "level", "less_db"),
    [
        *((eyes(0.6, roll_deg=roll_deg), "upright", 1.5) for roll_deg in (-90, 60, 90, 120)),
        # One eye is up to 4 cm nearer than the other.
        *((eyes_at(distance_m=0.7, angle_deg=angle), "ahead", 3.2) for angle in (-45, -30, 15, 30, 45)),
        # A walking viewer at the edge of the range: rows along y and along z are both much higher than the panels.
        (np.array([[0.85, 0.905, -0.01], [0.81, 0.94, -0.05]]), "far aside", 1.5),
    ],
)
def test_a_head_tilted_or_at_the_side_is_served_as_well(pair: np.ndarray, level: str, less_db: float) -> None:
    assert displayed(solved("balanced", pair), pair, STACK).psnr_db > level_db(level) - less_db


def test_a_turned_and_tilted_head_gives_the_network_no_larger_raster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Transposed rows, which such a head does not need, would be three times as much work."""
    sizes = []
    run = ModelSession.run

    def counted(self: ModelSession, feeds: dict[str, np.ndarray], shapes: dict[str, tuple[int, ...]]) -> object:
        sizes.append(feeds["left"].size)
        return run(self, feeds, shapes)

    monkeypatch.setattr(ModelSession, "run", counted)
    predictor = load_predictor("fast", STACK)
    # At the side: one eye is nearer, and the eyes are farther apart in height than sideways.
    turned = np.array([[0.85, 1.015, -0.011], [0.81, 1.045, -0.049]])
    for pair in (eyes(0.7), turned):
        predictor.solve(drawn_job([GREY, GREY], pair, STACK))
    assert sizes[1] < 1.5 * sizes[0]


@pytest.mark.parametrize(
    ("pair", "sigma_m", "error"),
    [
        (np.array([[0.6, 0.0, 0.0], [0.66, 0.0, 0.0]]), 1e-3, EyesNotServed),  # a passing failure
        (eyes(0.6), np.nan, ModelFailure),
        (eyes(0.6), np.inf, ModelFailure),
    ],
)
def test_what_cannot_be_solved_is_a_model_failure(pair: np.ndarray, sigma_m: float, error: type[ModelFailure]) -> None:
    with pytest.raises(error, match="no horizontal separation" if error is EyesNotServed else "."):
        load_predictor("fast", STACK).solve(replace(drawn_job([GREY, GREY], pair, STACK), eye_sigma_m=sigma_m))


def test_one_eye_that_stands_for_both_is_served() -> None:
    """The other eye can't see the display, and gave way."""
    predictor, eye = load_predictor("fast", STACK), eyes(0.6)[[0, 0]]
    picture = card_scene(eye[0])
    layers = solve_still(picture, picture, eyes_m=eye, fov_deg=FOV_DEG, predictor=predictor).layers
    assert displayed(layers, eye, STACK).psnr_db > 30


def test_solving_for_sigma_helps_displaced_eyes_and_costs_exact_ones() -> None:
    pair = POSES["in front"]
    pictures = [card_scene(eye) for eye in pair]
    predictor = load_predictor("balanced", STACK, ModelSettings(threads=1))
    shown = {
        sigma_mm: solve_still(
            *pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor, eye_sigma_mm=sigma_mm
        ).layers.copy()
        for sigma_mm in (0.0, 12.0)
    }
    expected = {
        s: expected_psnrs_db(layers, pictures, STACK, sampling=ONE_RAY, eyes_m=pair, fov_deg=FOV_DEG, sigmas_mm=[12.0])[
            12.0
        ]
        for s, layers in shown.items()
    }
    assert expected[12.0] > expected[0.0] + 0.7
    exact = {s: displayed(layers, pair, STACK).psnr_db for s, layers in shown.items()}
    assert exact[0.0] > exact[12.0] + 1


@pytest.mark.parametrize("pose", POSES)
def test_every_pixel_on_a_ray_through_all_panels_is_solved(pose: str) -> None:
    pair = POSES[pose]
    boxes = visible_boxes(pair, STACK)
    for eye in pair:
        image = image_from_stack(eye, width_px=480, height_px=270, fov_deg=70)
        v, u = np.mgrid[:270, :480] + 0.5
        positions = [projected(matrix, u, v)[:2] for matrix in layers_from_image(image, STACK, eye)]
        through = np.ones((270, 480), bool)
        for u, v in positions:
            through &= (u > 0.5) & (u < 479.5) & (v > 0.5) & (v < 269.5)
        for box, (u, v) in zip(boxes, positions, strict=True):
            if through.any():
                assert box.u0 <= u[through].min() - 0.5 and box.u1 >= u[through].max() + 0.5
                assert box.v0 <= v[through].min() - 0.5 and box.v1 >= v[through].max() + 0.5


def test_missing_kernels_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "runtime.kernels.compiled", None)
    with pytest.raises(ImportError, match="not compiled for this Python"):
        kernels.library.__wrapped__()
