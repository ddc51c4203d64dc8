"""`phasestack train`: a model's numbers, by the light that eyes get of what it solves.

Learned through the whole of the runtime's solver, as it ships: every unrolled step, clipping, eight bits, real pixels.
Its numbers are few (the network's, the steps' sizes and momenta), so they are searched for one by one, without
gradients: compass search (Kolda, Lewis and Torczon, SIAM Review 2003).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from model_export import network
from model_export.checkpoint import plain_weights, save_checkpoint, solver_of
from model_export.data import TrainingPair, endless_pairs
from model_export.export import in_torch, spectral_contract
from model_export.network import SpectralSolver
from model_export.recipe import Recipe, read_recipe
from runtime.errors import InputError, ModelFailure
from runtime.model.contract import Contract
from runtime.model.still import solve_still
from runtime.model.unrolled import UnrolledPredictor
from runtime.optics.carried import light_psnrs_db
from runtime.support.artifacts import write_text
from runtime.support.progress import progress_bar

HELD_OUT_SEED = 9_000_001  # of the validation pairs: no training seed reaches it
FIRST_MOVE = 0.15  # of a number: of weights, which are logarithms or shares, and of steps
LAST_MOVE = 0.01
COLUMNS = ("iteration", "light_db", "held_out_light_db")
Numbers = dict[str, float]


@dataclass(frozen=True, slots=True)
class Point:
    """The best so far after some solutions of all training pairs, in the order of COLUMNS."""

    iteration: int
    light_db: float  # for each pair's own uncertainty, mean over training pairs
    held_out_db: float  # the same of pairs that no search sees


def run_training(
    out: Path, recipe_name: str, *, iterations: int | None = None, seed: int | None = None
) -> dict[str, Any]:
    """Train, write checkpoint, recipe and curve. Raises InputError."""
    recipe = read_recipe(recipe_name)
    asked = {name: value for name, value in (("iterations", iterations), ("seed", seed)) if value is not None}
    training = recipe.training.model_copy(update=asked)
    net = solver_of(recipe.model_copy(update={"training": training}), source=recipe_name)
    recipe = recipe.model_copy(update={"training": training, "weights": plain_weights(net)})
    how: dict[str, Any] = training.model_dump(include={"width_px", "height_px", "eye_sigma_mm"})
    pairs, held_out = (
        [pair for pair, _ in zip(endless_pairs(seed, **how), range(count), strict=False)]
        for seed, count in ((training.seed, training.pairs), (HELD_OUT_SEED, training.validation_pairs))
    )
    start, best, at, learned = time.monotonic(), light_db(recipe, pairs), numbers_of(recipe), recipe
    if not math.isfinite(best):
        raise InputError(recipe_name, "weights", "the network answers with what is no number")
    points = [Point(0, best, light_db(recipe, held_out))]
    moves, done = dict.fromkeys(at, FIRST_MOVE), 0
    with progress_bar(f"training {recipe.name}") as progress:
        while done < training.iterations and max(moves.values()) > LAST_MOVE:
            for name in at:
                for towards in (1, -1):
                    found = recipe_with(recipe, {**at, name: at[name] + towards * moves[name]})
                    if found is None or done == training.iterations:
                        continue
                    done += 1
                    progress(done, training.iterations)
                    if (light := light_db(found, pairs)) > best:
                        best, at[name], learned = light, at[name] + towards * moves[name], found
                        _save(out, learned, points)  # whoever stops it has the best so far
                        break
                else:
                    moves[name] /= 2
            points.append(Point(done, best, light_db(learned, held_out)))
            _save(out, learned, points)
    return {
        "name": recipe.name,
        "iterations": done,
        "seconds": round(time.monotonic() - start, 1),
        "start_db": round(points[0].held_out_db, 3),
        "held_out_db": round(points[-1].held_out_db, 3),
        "checkpoint": str(out / "checkpoint.pth"),
    }


def light_db(recipe: Recipe, pairs: Sequence[TrainingPair]) -> float:
    """Mean over pairs, each for its own uncertainty; -inf where the network answers with what is no number."""
    net = solver_of(recipe, source=recipe.name)
    session: Any = TorchSession(net, spectral_contract(net, recipe))
    found: list[float] = []
    for pair in pairs:
        predictor = UnrolledPredictor(session, pair.stack)
        where: dict[str, Any] = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg}
        try:
            solved = solve_still(*pair.images, **where, predictor=predictor, eye_sigma_mm=pair.eye_sigma_mm)
        except ModelFailure:
            return -math.inf
        sigmas = (pair.eye_sigma_mm,)
        found += light_psnrs_db(solved.layers, pair.images, pair.stack, **where, sigmas_mm=sigmas).values()
    return float(np.mean(found))


class TorchSession:
    """What `UnrolledPredictor` asks of a model's session, by the module itself."""

    provider, fell_back = "torch", ()

    def __init__(self, net: SpectralSolver, contract: Contract) -> None:
        self.contract, self._run = contract, in_torch(net)

    def run(self, feeds: Mapping[str, Any], shapes: Mapping[str, Any]) -> dict[str, Any]:
        return dict(zip(network.OUTPUTS, self._run(dict(feeds)), strict=True))


def numbers_of(recipe: Recipe) -> Numbers:
    """All that is learned, by name: the network's weights, the steps' sizes, the joint steps' momenta."""
    found = {
        f"weights.{key}.{index}": value
        for key, values in (recipe.weights or {}).items()
        for index, value in enumerate(values)
    }
    for name, steps in (("steps", recipe.steps), ("refining", recipe.refining)):
        for index, step in enumerate(steps):
            if step.kind != "chain":
                found[f"{name}.{index}.size"] = step.size
            if step.momentum:
                found[f"{name}.{index}.momentum"] = step.momentum
    return found


def recipe_with(recipe: Recipe, numbers: Numbers) -> Recipe | None:
    """A recipe with other numbers; None where a step can't have them."""
    table = recipe.model_dump(mode="json")
    for name, value in numbers.items():
        group, place, field = name.split(".")
        if group == "weights":
            table[group][place][int(field)] = value
        else:
            table[group][int(place)][field] = value
    try:
        return Recipe.model_validate(table)
    except ValueError:
        return None


def _save(out: Path, recipe: Recipe, points: Sequence[Point]) -> None:
    net = solver_of(recipe, source=recipe.name)
    write_text(out / "recipe.json", recipe.model_copy(update={"weights": plain_weights(net)}).text())
    plain = recipe.model_copy(update={"weights": None}).model_dump(mode="json")
    save_checkpoint(out / "checkpoint.pth", {"model": net.state_dict(), "recipe": plain})
    lines = [",".join(f"{x:.6g}" for x in astuple(point)) for point in points]
    write_text(out / "validation.csv", "\n".join([",".join(COLUMNS), *lines]) + "\n")
