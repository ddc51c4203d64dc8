"""Read the shipped models' recipes, which are small JSON files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from runtime.config import Section, validated
from runtime.model.contract import Steps, TrainedFor
from runtime.support import untrusted_input

RECIPES = Path(__file__).parent / "recipes"
DESIGN_RANGE = TrainedFor(
    distance_m=(0.1, 4.0), off_axis_deg=(0.0, 70.0), separation_m=(0.015, 0.07), spacing_m=(0.005, 0.5)
)


class Recipe(Section):
    """Recipe for a shipped model, which is a closed-form network followed by solver steps."""

    name: str
    arch: Literal["spectral"] = "spectral"
    cell_px: Annotated[int, Field(ge=1, le=64)] = 4
    reduction: Literal[1, 2, 4] = 2
    steps: Steps = ()

    def sha256(self) -> str:
        """Return the SHA-256 of the recipe's canonical JSON, for inclusion in the contract."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


def read_recipe(name: str) -> Recipe:
    """Read a shipped model's recipe. Raises InputError if the recipe is missing or invalid."""
    path = RECIPES / f"{name}.json"
    return validated(Recipe, dict(untrusted_input.read_json(path)), source=path)
