"""Training: exact geometry of the data, a loss that is the runtime's own light, and determinism."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from model_export.checkpoint import load_spectral, plain_weights, solver_of  # noqa: E402
from model_export.data import TrainingPair, endless_pairs  # noqa: E402
from model_export.recipe import Recipe, read_recipe  # noqa: E402
from model_export.scene import Plane, Scene, draw  # noqa: E402
from model_export.train import light_db, numbers_of, recipe_with, run_training  # noqa: E402
from runtime.errors import InputError  # noqa: E402
from runtime.model.predictor import load_predictor  # noqa: E402
from runtime.model.still import solve_still  # noqa: E402
from runtime.optics.carried import light_psnrs_db  # noqa: E402
from runtime.optics.stack import PanelStack  # noqa: E402
from runtime.optics.views import raster_from_stack  # noqa: E402

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


def test_what_is_learned_is_the_light_that_the_runtime_gives_of_the_shipped_file() -> None:
    """The training's network and contract are those of the exported model: the same layers, the same figure."""
    pair = first_pairs(1, seed=3, width_px=480, height_px=270)[0]
    predictor = load_predictor("best", pair.stack)
    how = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg}
    solved = solve_still(*pair.images, **how, predictor=predictor, eye_sigma_mm=pair.eye_sigma_mm)
    predictor.close()
    seen = light_psnrs_db(solved.layers, pair.images, pair.stack, **how, sigmas_mm=(pair.eye_sigma_mm,))
    assert light_db(read_recipe("best"), [pair]) == pytest.approx(seen[pair.eye_sigma_mm], abs=0.02)


def test_a_number_goes_where_light_is_and_no_further_than_a_step_can() -> None:
    recipe = read_recipe("fast")
    recipe = recipe.model_copy(update={"weights": plain_weights(solver_of(recipe, source="test"))})
    numbers = numbers_of(recipe)
    assert {"weights.log_floor.0", "steps.1.size", "steps.2.size"} <= set(numbers)
    assert recipe_with(recipe, numbers) == recipe
    assert recipe_with(recipe, numbers | {"steps.1.size": 2.1}) is None
    pairs = first_pairs(1, seed=4, width_px=320, height_px=180)
    assert (
        light_db(recipe, pairs) > light_db(recipe_with(recipe, numbers | {"steps.2.size": 0.1}) or recipe, pairs) + 0.3
    )


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A recipe that trains in seconds."""
    table = json.loads(read_recipe("fast").text())
    table.pop("weights", None)
    table["training"] |= SMALL | {"iterations": 8, "pairs": 2, "validation_pairs": 2}
    path = tmp_path / "tiny.json"
    path.write_text(json.dumps(table))
    return path


def trained(out: Path, recipe: Path) -> Recipe:
    run_training(out, str(recipe))
    return Recipe.model_validate_json((out / "recipe.json").read_text())


def test_a_network_that_answers_with_no_number_is_refused_before_anything_is_written(
    tmp_path: Path, tiny: Path
) -> None:
    table = json.loads(tiny.read_text())
    weights = plain_weights(solver_of(read_recipe(str(tiny)), source="test"))
    tiny.write_text(json.dumps(table | {"weights": weights | {"log_floor": [1000.0, 1000.0]}}))
    with pytest.raises(InputError, match="weights: the network answers with what is no number"):
        run_training(tmp_path / "out", str(tiny))
    assert not (tmp_path / "out").exists()


def test_training_is_the_same_twice_and_leaves_its_files(tmp_path: Path, tiny: Path) -> None:
    first = trained(tmp_path / "a", tiny)
    assert trained(tmp_path / "b", tiny).weights == first.weights
    _, recipe = load_spectral(tmp_path / "a" / "checkpoint.pth", name="fast")
    assert recipe.steps == first.steps and recipe.weights == first.weights
    rows = [row.split(",") for row in (tmp_path / "a" / "validation.csv").read_text().splitlines()]
    assert rows[0] == ["iteration", "light_db", "held_out_light_db"] and [row[0] for row in rows[1:]] == ["0", "8"]
    assert float(rows[2][1]) > float(rows[1][1])
