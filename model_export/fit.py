"""Sizes of the steps and emphasis, found by trying: `python -m model_export.fit balanced --out recipe.json`.

The runtime itself is what is tried, on random pairs drawn from both eyes and anew from beside them. One number is
changed at a time and kept where the eyes see more; the weights of the network stay as the recipe has them.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model_export.checkpoint import solver_of
from model_export.export import spectral_file
from model_export.recipe import Recipe, read_recipe
from model_export.stills import random_still
from runtime.config import ModelSettings
from runtime.evaluation.displayed import Picture
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.optics.malus import HALF_PI
from runtime.optics.retina import panel_positions, ray_mask
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.report.pairs import StillPair
from runtime.support.artifacts import write_text

SEED = 777  # of the pairs: neither the training's nor those that models are judged on
BESIDE_MM = 2.0
SIZES = (5, 6, 7, 8, 9)  # eighths
EMPHASES = (0.03, 0.06, 0.09, 0.12, 0.15, 0.18)
LEAST_GAIN_DB = 0.01


@dataclass(frozen=True, slots=True)
class Sight:
    """Where one eye's rays meet each panel, and what it should see there."""

    places: tuple[Tensor, ...]  # per panel (1, h, w, 2), -1 to 1
    counts: Tensor  # (h, w) True where a ray crosses every panel
    wanted: Tensor  # (3, h, w) intensities


@dataclass(frozen=True, slots=True)
class FitPair:
    """A pair, and the sights that it is judged by."""

    pair: StillPair
    exact: tuple[Sight, ...]
    beside: tuple[tuple[Sight, ...], ...]  # both eyes moved the same way


def fit_pairs(count: int, *, width_px: int, height_px: int) -> list[FitPair]:
    """The pairs that are tried on, the same every time."""
    pairs = []
    for number in range(count):
        pair = random_still(SEED, number, width_px=width_px, height_px=height_px, beside_mm=BESIDE_MM)
        exact = tuple(
            _sight(eye, picture, pair.stack, pair.fov_deg)
            for eye, picture in zip(pair.eyes_m, pair.images, strict=True)
        )
        off = [_sight(place.eye_m, place.image, pair.stack, pair.fov_deg) for place in pair.off]
        pairs.append(FitPair(pair, exact, tuple(zip(off[::2], off[1::2], strict=True))))
    return pairs


def displayed_db(recipe: Recipe, pairs: Sequence[FitPair]) -> tuple[float, float]:
    """Mean dB at the eyes and BESIDE_MM beside them, through the runtime."""
    exact, beside = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tried.onnx"
        path.write_bytes(spectral_file(solver_of(recipe, source=recipe.name), recipe))
        for case in pairs:
            predictor = load_predictor(str(path), case.pair.stack, ModelSettings())
            pair = case.pair
            layers = solve_still(*pair.images, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg, predictor=predictor).layers
            exact.append(_seen_db(layers, case.exact))
            beside.append(float(np.mean([_seen_db(layers, sights) for sights in case.beside])))
            predictor.close()
    return float(np.mean(exact)), float(np.mean(beside))


def changes(recipe: Recipe) -> Iterator[tuple[str, Callable[[Recipe], Recipe]]]:
    """Ways to change one number of a recipe, each with its name: the emphasis, or the size of a front and rear step."""
    for emphasis in EMPHASES:
        yield f"emphasis {emphasis:g}", partial(_with_emphasis, emphasis)
    for index, step in enumerate(recipe.steps):
        if step.kind == "front":
            for eighths in SIZES:
                yield f"step {index + 1}: {eighths}/8", partial(_with_size, index, eighths / 8)


def _with_emphasis(emphasis: float, recipe: Recipe) -> Recipe:
    return recipe.model_copy(update={"emphasis": emphasis})


def _with_size(index: int, size: float, recipe: Recipe) -> Recipe:
    """A front step's size, and that of the rear step that follows it."""
    steps = list(recipe.steps)
    for at in (index, index + 1):
        if at < len(steps) and steps[at].kind != "chain":
            steps[at] = steps[at].model_copy(update={"size": size})
    return recipe.model_copy(update={"steps": tuple(steps)})


def fitted(
    recipe: Recipe, tried: Callable[[Recipe], tuple[float, float]], *, sweeps: int, tell: Callable[[str], None]
) -> Recipe:
    """The best recipe met by changing one number at a time; exact eyes and eyes beside count the same."""
    best, at_best = recipe, sum(tried(recipe))
    for _ in range(sweeps):
        before = at_best
        for name, change in changes(recipe):
            changed = change(best)
            if changed == best:
                continue
            exact_db, beside_db = tried(changed)
            kept = exact_db + beside_db > at_best + LEAST_GAIN_DB
            tell(f"{name:20s} {exact_db:.3f} {beside_db:.3f}{' kept' if kept else ''}")
            if kept:
                best, at_best = changed, exact_db + beside_db
        if at_best == before:
            break
    return best


def _sight(eye_m: F64, picture: Picture, stack: PanelStack, fov_deg: float) -> Sight:
    height, width = picture.shape[:2]
    mask = ray_mask(eye_m, stack, width_px=width, height_px=height, fov_deg=fov_deg)
    places = []
    for index in range(stack.count):
        positions = panel_positions(eye_m, stack, index=index, width_px=width, height_px=height, fov_deg=fov_deg)
        u, v = (np.broadcast_to(part, mask.shape) for part in positions)
        mask = mask & (u > 0.5) & (u < stack.width_px - 0.5) & (v > 0.5) & (v < stack.height_px - 0.5)
        place = np.stack([u * 2 / stack.width_px - 1, v * 2 / stack.height_px - 1], axis=-1).astype(np.float32)
        places.append(torch.from_numpy(place)[None])
    wanted = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1).float() / 255
    return Sight(tuple(places), torch.from_numpy(mask), wanted)


def _seen_db(layers: U8, sights: Sequence[Sight]) -> float:
    """Displayed PSNR pooled over sights (EyeReal supplement, (6), (7)), in single precision."""
    panels = [torch.from_numpy(np.ascontiguousarray(layer[..., :3])).permute(2, 0, 1)[None].float() for layer in layers]
    squared, count = 0.0, 0
    for sight in sights:
        total = torch.zeros_like(sight.wanted)
        for panel, places in zip(panels, sight.places, strict=True):
            total += functional.grid_sample(panel, places, padding_mode="border", align_corners=False)[0]
        error = (torch.sin(total * (HALF_PI / 255)) ** 2 - sight.wanted)[:, sight.counts]
        squared, count = squared + float(error.square().sum()), count + error.numel()
    return -10 * math.log10(squared / count + 1e-12)


def main() -> int:
    """Fit one recipe and write it."""
    parser = argparse.ArgumentParser(prog="python -m model_export.fit", description=__doc__)
    parser.add_argument("recipe", help="a shipped name, or a JSON file")
    parser.add_argument("--out", type=Path, required=True, help="the recipe that was found")
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=540)
    parser.add_argument("--sweeps", type=int, default=2)
    asked = parser.parse_args()
    recipe = read_recipe(asked.recipe)
    pairs = fit_pairs(asked.pairs, width_px=asked.width, height_px=asked.height)
    print("start                {:.3f} {:.3f}".format(*displayed_db(recipe, pairs)))
    found = fitted(
        recipe,
        lambda tried: displayed_db(tried, pairs),
        sweeps=asked.sweeps,
        tell=lambda text: print(text, flush=True),
    )
    write_text(asked.out, found.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
