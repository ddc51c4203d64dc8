"""Weights that follow a law, before or instead of a training: `python -m model_export.law NAME --growth G --out DIR`.

λ = 0.01 + growth·t² (t: tolerance in millimetres at the ordinary separation of eyes), the same for every frequency.
Its numbers were chosen on procedural pairs and built-in scenes (docs/models.md). What a training finds starts here;
without weights the network starts from one constant.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from torch import Tensor

from model_export.checkpoint import plain_weights
from model_export.network import SpectralSolver
from model_export.recipe import Recipe, read_recipe
from runtime.model.chain import RELATIVE_TOLERANCE_MAX_MM
from runtime.support.artifacts import write_text

AT_NONE = 0.01
SEED = 1
ITERATIONS = 200


def regularisation(tolerance_mm: Tensor, *, growth: float) -> Tensor:
    """λ for tolerances in millimetres."""
    return AT_NONE + growth * tolerance_mm**2


def following(recipe: Recipe, *, growth: float) -> Recipe:
    """The recipe with weights that follow the law to some hundredths; the same every time."""
    torch.manual_seed(SEED)
    solver = SpectralSolver(recipe.hidden)
    tolerances = torch.linspace(0.0, RELATIVE_TOLERANCE_MAX_MM, 65)
    spectrum = torch.linspace(0.01, 4.0, 24)
    wanted = torch.log(regularisation(tolerances, growth=growth))
    optimiser = torch.optim.LBFGS(solver.parameters(), max_iter=ITERATIONS, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        found = torch.stack([torch.log(solver.regularisation(spectrum, t.reshape(1))) for t in tolerances])
        error = (found - wanted[:, None]).square().mean()
        error.backward()  # type: ignore[no-untyped-call]
        return error

    optimiser.step(loss)  # type: ignore[no-untyped-call]
    return recipe.model_copy(update={"weights": plain_weights(solver)})


def main() -> int:
    """Put the weights into recipe files."""
    parser = argparse.ArgumentParser(prog="python -m model_export.law", description=__doc__)
    parser.add_argument("recipes", nargs="+", help="shipped names or JSON files: read")
    parser.add_argument("--out", type=Path, required=True, help="folder: written, NAME.json each")
    parser.add_argument("--growth", type=float, required=True, help="per square millimetre")
    asked = parser.parse_args()
    for name in asked.recipes:
        recipe = following(read_recipe(name), growth=asked.growth)
        write_text(asked.out / f"{recipe.name}.json", recipe.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
