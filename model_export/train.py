"""`phasestack train`: the network's weights, by what unsure eyes see."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from model_export.checkpoint import plain_weights, save_checkpoint, solver_of
from model_export.data import TrainingPair, endless_pairs
from model_export.network import SpectralSolver
from model_export.recipe import Recipe, read_recipe
from model_export.sight import displayed_mse, sight_of
from runtime.support.artifacts import write_text
from runtime.support.progress import progress_bar

HELD_OUT_SEED = 9_000_001  # of the validation pairs: no training seed reaches it
PAIRS_A_STEP = 2
FLOOR = 1e-6  # of the squared error in the loss: beyond 60 dB nothing is gained
GRADIENT_MAX = 5.0
COLUMNS = ("iteration", "training_loss_db", "held_out_exact_db", "held_out_expected_db")


@dataclass(frozen=True, slots=True)
class Point:
    """What was measured after some steps, in the order of COLUMNS."""

    iteration: int
    training_loss_db: float  # mean since the last point; NaN before the first step
    exact_db: float  # displayed PSNR at the eyes, mean over held-out pairs
    expected_db: float  # over each pair's uncertainty, of those that have one


def run_training(
    out: Path,
    recipe_name: str,
    *,
    iterations: int | None = None,
    seed: int | None = None,
) -> dict[str, Any]:
    """Train, write checkpoint, recipe and curve. Raises InputError."""
    recipe = read_recipe(recipe_name)
    asked = {name: value for name, value in (("iterations", iterations), ("seed", seed)) if value is not None}
    training = recipe.training.model_copy(update=asked)
    recipe = recipe.model_copy(update={"training": training})
    model = solver_of(recipe, source=recipe_name)
    optimiser = torch.optim.Adam(model.parameters(), lr=training.learning_rate)
    size = {"width_px": training.width_px, "height_px": training.height_px}
    held_out = held_out_pairs(training.validation_pairs, **size)
    start = time.monotonic()
    points = [Point(0, math.nan, *validate(model, held_out, recipe))]
    stream = endless_pairs(training.seed, eye_sigma_mm=training.eye_sigma_mm, **size)
    losses: list[float] = []
    with progress_bar(f"training {recipe.name}") as progress:
        for iteration in range(training.iterations):
            optimiser.param_groups[0]["lr"] = training.learning_rate * _annealed(iteration / training.iterations)
            losses.append(_step(model, optimiser, stream, recipe))
            done = iteration + 1
            progress(done, training.iterations)
            if done % training.validate_every == 0 or done == training.iterations:
                points.append(Point(done, float(np.mean(losses)), *validate(model, held_out, recipe)))
                losses = []
                _save(out, model, recipe, points)
    last = points[-1]
    return {
        "name": recipe.name,
        "iterations": last.iteration,
        "seconds": round(time.monotonic() - start, 1),
        "start_db": round(points[0].exact_db, 3),
        "held_out_db": round(last.exact_db, 3),
        "start_expected_db": round(points[0].expected_db, 3),
        "held_out_expected_db": round(last.expected_db, 3),
        "checkpoint": str(out / "checkpoint.pth"),
    }


def pair_loss(model: SpectralSolver, pair: TrainingPair, recipe: Recipe) -> Tensor:
    """Displayed error in dB, expected over the eyes' uncertainty."""
    _, expected = displayed_mse(model, sight_of(pair, recipe))
    return 10 * torch.log10(expected + FLOOR)


def held_out_pairs(count: int, *, width_px: int, height_px: int) -> list[TrainingPair]:
    """Pairs that no training sees, the same every time."""
    stream = endless_pairs(HELD_OUT_SEED, width_px=width_px, height_px=height_px, eye_sigma_mm=(0.0, 4.0))
    return [pair for pair, _ in zip(stream, range(count), strict=False)]


@torch.no_grad()
def validate(model: SpectralSolver, pairs: Sequence[TrainingPair], recipe: Recipe) -> tuple[float, float]:
    """Mean dB at the eyes, and mean dB expected of the pairs with unsure eyes."""
    exact_db, expected_db = [], []
    for pair in pairs:
        exact, expected = (-10 * math.log10(float(e) + FLOOR) for e in displayed_mse(model, sight_of(pair, recipe)))
        exact_db.append(exact)
        expected_db += [expected] if pair.eye_sigma_mm > 0 else []
    return float(np.mean(exact_db)), float(np.mean(expected_db)) if expected_db else math.nan


def _annealed(done: float) -> float:
    """Of the learning rate: a short warm-up, then half a cosine down to a twentieth."""
    return min(1.0, 0.1 + done * 20) * (0.05 + 0.95 * (1 + math.cos(math.pi * done)) / 2)


def _step(
    model: SpectralSolver,
    optimiser: torch.optim.Optimizer,
    stream: Iterator[TrainingPair],
    recipe: Recipe,
) -> float:
    """One step of the optimiser. A pair that nobody can see is passed over."""
    optimiser.zero_grad()
    total, used = 0.0, 0
    for _ in range(PAIRS_A_STEP):
        try:
            loss = pair_loss(model, next(stream), recipe)
        except ValueError:
            continue
        if bool(torch.isfinite(loss)):
            (loss / PAIRS_A_STEP).backward()  # type: ignore[no-untyped-call]
            total, used = total + float(loss.detach()), used + 1
    torch.nn.utils.clip_grad_norm_(model.parameters(), GRADIENT_MAX)
    optimiser.step()
    return total / used if used else math.nan


def _save(out: Path, model: SpectralSolver, recipe: Recipe, points: Sequence[Point]) -> None:
    found = recipe.model_copy(update={"weights": plain_weights(model)})
    write_text(out / "recipe.json", found.text())
    plain = found.model_copy(update={"weights": None}).model_dump(mode="json")
    save_checkpoint(out / "checkpoint.pth", {"model": model.state_dict(), "recipe": plain})
    lines = [",".join("" if math.isnan(x) else f"{x:.6g}" for x in astuple(point)) for point in points]
    write_text(out / "validation.csv", "\n".join([",".join(COLUMNS), *lines]) + "\n")
