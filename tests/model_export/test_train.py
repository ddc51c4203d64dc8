"""Training: exact geometry of the data, a loss that agrees with the runtime's rays, and determinism."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
from model_export.checkpoint import load_spectral, solver_of  # noqa: E402
from model_export.data import TrainingPair, endless_pairs  # noqa: E402
from model_export.recipe import Recipe, read_recipe  # noqa: E402
from model_export.scene import Plane, Scene, draw  # noqa: E402
from model_export.sight import displayed_mse, sight_of  # noqa: E402
from model_export.train import pair_loss, run_training  # noqa: E402
from runtime.config import ModelSettings  # noqa: E402
from runtime.model.job import Job  # noqa: E402
from runtime.model.predictor import load_predictor  # noqa: E402
from runtime.model.resample import target_from_source  # noqa: E402
from runtime.optics.stack import PanelStack  # noqa: E402
from runtime.optics.views import raster_from_stack  # noqa: E402
from tests.model.scenes import sampled  # noqa: E402

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
EYES = np.array([[0.7, -0.0315, 0.02], [0.7, 0.0315, 0.02]])
SMALL = {"width_px": 160, "height_px": 96}


def first_pairs(count: int, *, seed: int = 1, **size: int) -> list[TrainingPair]:
    stream = endless_pairs(seed, eye_sigma_mm=(0.0, 4.0), **(size or SMALL))
    return [pair for pair, _ in zip(stream, range(count), strict=False)]


def drawn(scene: Scene, eye: np.ndarray) -> np.ndarray:
    return draw(scene, raster_from_stack(eye, STACK.panel(1)), width_px=480, height_px=270)


# A texture is drawn twice as fine as the raster and averaged: its edges are true to about a tenth of a pixel.
def test_a_plane_is_drawn_where_the_projection_puts_it() -> None:
    white = np.full((40, 40, 4), 255, np.uint8)
    centre = np.array([-0.1, 0.05, -0.03])
    plane = Plane(white, centre - [0, 0.01, -0.01], np.array([0, 0.02, 0.0]), np.array([0, 0, -0.02]))
    for eye in EYES:
        picture = drawn((plane,), eye).mean(axis=2)
        v_px, u_px = np.mgrid[0:270, 0:480] + 0.5
        u, v, w = raster_from_stack(eye, STACK.panel(1)) @ [*centre, 1.0]
        assert (u_px * picture).sum() / picture.sum() == pytest.approx(u / w, abs=0.12)
        assert (v_px * picture).sum() / picture.sum() == pytest.approx(v / w, abs=0.12)


def test_the_nearer_plane_hides_the_farther_whatever_their_order() -> None:
    def plane(x_m: float, grey: int) -> Plane:
        texture = np.dstack([np.full((8, 8, 3), grey, np.uint8), np.full((8, 8), 255, np.uint8)])
        corner = np.array([x_m, -1.0, 1.0])
        return Plane(texture, corner, np.array([0, 2.0, 0]), np.array([0, 0, -2.0]))

    near, far = plane(0.1, 200), plane(-0.2, 50)
    for scene in ((near, far), (far, near)):
        assert drawn(scene, EYES[0])[135, 240].tolist() == [200, 200, 200]


def test_pairs_depend_on_seed_and_number_alone() -> None:
    whole = first_pairs(4)
    again = first_pairs(3)[2]
    assert np.array_equal(again.images[1], whole[2].images[1]) and np.array_equal(again.eyes_m, whole[2].eyes_m)
    assert not np.array_equal(first_pairs(1, seed=2)[0].images[0], whole[0].images[0])


def test_poses_stay_within_the_design_range() -> None:
    for pair in first_pairs(60, width_px=64, height_px=64):
        eyes, middle = pair.eyes_m, pair.eyes_m.mean(axis=0)
        assert 0.01 < np.linalg.norm(eyes[1] - eyes[0]) < 0.0701
        assert eyes[1, 1] > eyes[0, 1]
        assert eyes[:, 0].min() > pair.stack.x_m[2] + 0.08
        assert np.linalg.norm(middle) < 4.2
        assert 0.005 <= pair.stack.x_m[2] <= 0.5
        assert 0 <= pair.eye_sigma_mm <= 4


def test_the_raster_s_own_sight_is_what_eyes_see_of_panels_that_are_drawn_on_it() -> None:
    """Against the runtime's rays: the network's answer, drawn on the panels, no correction."""
    recipe = read_recipe("balanced").model_copy(update={"emphasis": 0.0})
    net = solver_of(recipe, source="test")
    pair = first_pairs(1, seed=3, width_px=480, height_px=270)[0]
    # Detail that the raster, half as fine as the panels, can't hold is none of its business.
    smooth = tuple(cv2.GaussianBlur(picture, (0, 0), 3.0) for picture in pair.images)
    pair = replace(pair, images=smooth, eye_sigma_mm=4.0)
    with torch.no_grad():
        sight = sight_of(pair, recipe)
        ours = displayed_mse(net, sight)
    predictor = load_predictor("balanced", pair.stack, ModelSettings(threads=1))
    session = predictor.session  # type: ignore[attr-defined]
    alone = {"steps": session.contract.steps[:1], "emphasis": 0.0}
    session.contract = session.contract.model_copy(update=alone)
    rgba = [[cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA)] for picture in pair.images]
    layers = predictor.solve(Job(rgba, pair.eyes_m, eye_sigma_mm=4.0)).layers[..., :3].astype(np.float64) / 255
    predictor.close()
    errors = []
    for eye, picture in zip(pair.eyes_m, pair.images, strict=True):
        phase, counts = layers[1].copy(), np.ones(picture.shape[:2], bool)
        v, u = np.mgrid[0:270, 0:480] + 0.5
        for n in (0, 2):
            m = target_from_source(eye, source=pair.stack.panel(1), target=pair.stack.panel(n))
            x, y = m[0, 0] * u + m[0, 2], m[1, 1] * v + m[1, 2]
            counts &= (x > 2) & (x < 478) & (y > 2) & (y < 268)
            x, y = np.broadcast_arrays(x, y)
            phase += sampled(layers[n], x, y)
        errors.append(np.square(np.sin(phase * np.pi / 2) ** 2 - picture / 255)[counts].mean())
    theirs_db, ours_db = -10 * np.log10(np.mean(errors)), -10 * np.log10(float(ours[0]))
    mirrored = replace(sight, wanted=sight.wanted[::-1])
    with torch.no_grad():
        wrong_db = -10 * np.log10(float(displayed_mse(net, mirrored)[0]))
    assert ours_db == pytest.approx(theirs_db, abs=8.0)  # eight bits and the panels' own pixels
    assert wrong_db < ours_db - 15, "the wrong eye's sight would be no better"
    assert float(ours[1]) > float(ours[0])


def test_what_is_learned_gets_gradients_and_steps_down_the_loss() -> None:
    recipe = read_recipe("balanced").model_copy(update={"weights": None})
    model = solver_of(recipe, source="test")
    pair = first_pairs(1, seed=4, width_px=320, height_px=180)[0]
    loss = pair_loss(model, pair, recipe)
    loss.backward()
    gradient = torch.cat([p.grad.reshape(-1) for p in model.parameters() if p.grad is not None])
    assert torch.isfinite(gradient).all() and gradient.norm() > 0
    with torch.no_grad():
        for p in model.parameters():
            if p.grad is not None:
                p -= 0.02 * p.grad / gradient.norm()
        assert pair_loss(model, pair, recipe) < loss


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A recipe that trains in seconds."""
    table = json.loads(read_recipe("fast").text())
    table.pop("weights", None)
    table["training"] |= SMALL | {"iterations": 2, "validate_every": 1, "validation_pairs": 2}
    path = tmp_path / "tiny.json"
    path.write_text(json.dumps(table))
    return path


def trained(out: Path, recipe: Path) -> Recipe:
    run_training(out, str(recipe))
    return Recipe.model_validate_json((out / "recipe.json").read_text())


def test_training_is_the_same_twice_and_leaves_its_files(tmp_path: Path, tiny: Path) -> None:
    first = trained(tmp_path / "a", tiny)
    assert trained(tmp_path / "b", tiny).weights == first.weights
    _, recipe = load_spectral(tmp_path / "a" / "checkpoint.pth", name="fast")
    assert recipe.steps == first.steps and recipe.weights == first.weights
    rows = (tmp_path / "a" / "validation.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["iteration", "0", "1", "2"]
