"""Recipes: how a model is made, and what its training found. One small JSON file each."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from runtime.config import Section, validated
from runtime.errors import InputError
from runtime.model.contract import Refining, Steps, TrainedFor
from runtime.model.predictor import SHIPPED
from runtime.support import untrusted_input

RECIPES = Path(__file__).parent / "recipes"
DESIGN_RANGE = TrainedFor(
    distance_m=(0.1, 4.0), off_axis_deg=(0.0, 70.0), separation_m=(0.015, 0.07), spacing_m=(0.005, 0.5)
)


class Training(Section):
    """What `phasestack train` does with a recipe."""

    iterations: Annotated[int, Field(ge=1)] = Field(400, description="solutions of all training pairs, at most")
    seed: Annotated[int, Field(ge=0)] = 1
    width_px: Annotated[int, Field(ge=64)] = Field(480, description="raster of the training pairs")
    height_px: Annotated[int, Field(ge=64)] = 270
    eye_sigma_mm: tuple[float, float] = Field((0.0, 4.0), description="range of the uncertainties that are drawn")
    pairs: Annotated[int, Field(ge=1)] = 12
    validation_pairs: Annotated[int, Field(ge=1)] = 12


class Recipe(Section):
    """A model of the spectral family: its unrolled steps, its training, and the weights that came of it."""

    name: str
    arch: Literal["spectral"] = "spectral"
    iterations: Annotated[int, Field(ge=0, le=32)] = Field(4, description="of the box, within the network")
    cell_px: Annotated[int, Field(ge=1, le=64)] = 4
    reduction: Literal[1, 2, 4] = 2
    emphasis: Annotated[float, Field(ge=0, le=0.5)] = Field(
        0.0,
        description="strength of the sharpening that undoes the blur of interpolation, on the way in and in the eye",
    )
    interpolation: Literal["linear", "cubic"] = "linear"
    steps: Annotated[Steps, Field(min_length=1)]
    refining: Refining = ()
    training: Training = Training()
    weights: dict[str, Any] | None = Field(None, description="state_dict as nested lists; none: the analytic start")

    def canonical(self) -> bytes:
        """The same bytes for the same recipe."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":")).encode()

    def sha256(self) -> str:
        """Of the recipe with its weights: what the contract carries."""
        return hashlib.sha256(self.canonical()).hexdigest()

    def text(self) -> str:
        """As a file holds it."""
        return json.dumps(self.model_dump(mode="json", exclude_none=True), indent=1) + "\n"


def recipe_path(name: str) -> Path:
    """The file of a shipped recipe, or of a path. Raises InputError for neither."""
    if name in SHIPPED:
        return RECIPES / f"{name}.json"
    path = Path(name)
    if path.suffix != ".json":
        raise InputError("recipe", "", f"{name!r} is neither {', '.join(SHIPPED)} nor a JSON file")
    return path


def read_recipe(name: str) -> Recipe:
    """A recipe by name or file. Raises InputError."""
    path = recipe_path(name)
    table = untrusted_input.read_json(path)
    if not isinstance(table, dict):
        raise InputError(path, "", "must be one JSON object")
    return validated(Recipe, table, source=path)
