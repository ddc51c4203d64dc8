"""Contract in a model file (docs/contracts.md), checked when the model is loaded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from runtime.errors import InputError
from runtime.kernels import MAX_PANELS
from runtime.support.sections import Section, validated

METADATA_KEY = "phasestack.contract"
VERSION = 2


Places = Literal["middle", "rising", "falling"]


class Step(Section):
    """One update of all panels (docs/mathematics.md, L5)."""

    size: Annotated[float, Field(gt=0, le=3)] = 1.0
    momentum: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.7, description="fraction of a step's update to carry into the next step"
    )
    floor: Annotated[float, Field(gt=0, le=1)] = Field(
        0.1, description="lower limit of the squared slope of an eye's intensity"
    )
    places: Places = Field(
        "middle",
        description="assumed head position: the estimate, or positions one standard deviation to its left and right "
        "on alternate picture rows, with the right-hand one on the upper row (rising) or the lower row (falling)",
    )


Steps = Annotated[tuple[Step, ...], Field(max_length=64, description="updates of all panels that follow the network")]


class TrainedFor(Section):
    """Ranges of eye positions and panel gaps that the model was trained on."""

    distance_m: tuple[float, float]
    off_axis_deg: tuple[float, float]
    separation_m: tuple[float, float]
    spacing_m: tuple[float, float]


class Port(Section):
    """A network input or output."""

    name: Annotated[str, Field(min_length=1)]
    axes: Annotated[tuple[str, ...], Field(max_length=8)] = Field(description="what each dimension counts")


class Contract(Section):
    """Properties of a model, as declared in its metadata entry `phasestack.contract`."""

    version: Literal[2]
    arch: str
    name: str
    panels: Annotated[int, Field(ge=2, le=MAX_PANELS)]
    eyes: Literal[2]
    input_frame: Literal["panel", "centre", "chain"]
    input_value: Literal["intensity", "phase"]
    layout: Literal["NCHW", "RNC"] = Field(description="RNC: rows, chain cells, columns of a cell by channels")
    eye_order: Literal["left-right", "right-left"]
    output: Literal["panels", "outer"]
    branch: Literal[1, 2]
    value_range: tuple[float, float]
    trained_for: TrainedFor | None = Field(description="null if unknown or untrained")
    recipe_sha256: str
    width_px: Annotated[int, Field(ge=0, le=16384)] = Field(0, description="fixed input width (0 for any)")
    height_px: Annotated[int, Field(ge=0, le=16384)] = Field(0, description="fixed input height (0 for any)")
    inputs: Annotated[tuple[Port, ...], Field(min_length=1, max_length=32)]
    outputs: Annotated[tuple[Port, ...], Field(min_length=1, max_length=32)]
    graph_sha256: str = Field("", description="SHA-256 of the file without its metadata (empty if not specified)")
    precision: Literal["fp32", "fp16", "int8"] = "fp32"
    parameters: Annotated[int, Field(ge=0)] = 0
    cell_px: Annotated[int, Field(ge=1, le=64)] = Field(
        4, description="for `chain`: parallax of the outer panels, in columns of the network's raster"
    )
    reduction: Literal[1, 2, 4] = Field(2, description="for `chain`: factor by which a panel's resolution is divided")
    picture_fov_deg: Annotated[float, Field(ge=0, lt=180)] = Field(
        0.0,
        description="horizontal field of view of the training pictures, which are black outside it (0 for unlimited)",
    )
    steps: Steps = ()


def parse_contract(metadata: dict[str, str], *, source: str | Path) -> Contract:
    """Return the contract in an ONNX file's metadata. Raises InputError if it is missing or invalid."""
    text = metadata.get(METADATA_KEY)
    if text is None:
        raise InputError(source, METADATA_KEY, "the model has no contract; export it with `phasestack export`")
    try:
        table: Any = json.loads(text)
    except RecursionError:
        raise InputError(source, METADATA_KEY, "malformed: nested too deeply") from None
    except ValueError as error:
        raise InputError(source, METADATA_KEY, f"malformed: {error}") from None
    if not isinstance(table, dict):
        raise InputError(source, METADATA_KEY, "must be one JSON object")
    if table.get("version") != VERSION:
        raise InputError(
            source,
            f"{METADATA_KEY}.version",
            f"must be {VERSION}, not {table.get('version')!r}; export the model again",
        )
    return validated(Contract, table, source=source)
