"""`phasestack export`: weights to a checked ONNX file."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from model_export import eyereal, network
from model_export.checkpoint import FILE_BYTES_MAX, load_eyereal, load_spectral, solver_of
from model_export.eyereal import LEAST_PX, OFFSET, PICTURE_FOV_DEG, EyeRealNet
from model_export.network import SpectralSolver
from model_export.onnx_files import eyereal_bytes, ports, spectral_bytes, with_contract
from model_export.recipe import DESIGN_RANGE, Recipe, read_recipe
from model_export.stress import Feeds
from model_export.validate import Reference, Report, check_model
from runtime.errors import InputError
from runtime.model.contract import Contract
from runtime.model.predictor import SHIPPED
from runtime.support import untrusted_input
from runtime.support.artifacts import write_bytes

EyeOrder = Literal["left-right", "right-left"]


def export_model(
    arch: str,
    out: Path,
    *,
    checkpoint: Path | None = None,
    random_init: int | None = None,
    width_px: int = 1920,
    height_px: int = 1080,
    eye_order: EyeOrder = "left-right",
) -> Report:
    """Make, check, and write where every check passed. Raises InputError."""
    if arch not in (*SHIPPED, "eyereal"):
        raise InputError("export", "--arch", f"{arch!r} is neither {', '.join(SHIPPED)} nor eyereal")
    if checkpoint is not None and random_init is not None:
        raise InputError("export", "--random-init", "and --checkpoint exclude one another")
    if arch == "eyereal" and checkpoint is None and random_init is None:
        raise InputError("export", "--checkpoint", "or --random-init is needed: eyereal's weights aren't shipped")
    for option, value in (("--width", width_px), ("--height", height_px)):
        if value < LEAST_PX or value > 8192 or value % 2:
            raise InputError("export", option, f"{value} must be an even number from {LEAST_PX} to 8192")
    if arch == "eyereal":
        size = {"width_px": width_px, "height_px": height_px}
        data, module = eyereal_model(checkpoint, random_init=random_init, eye_order=eye_order, **size)
    else:
        data, module = spectral_model(arch, checkpoint=checkpoint, random_init=random_init)
    report = check_model(data, source=str(out), reference=in_torch(module))
    if report.passed:
        write_bytes(out, data)
    return report


def in_torch(module: nn.Module) -> Reference:
    """A module as a reference of its export."""

    def run(feeds: Feeds) -> Sequence[np.ndarray]:
        with torch.no_grad():
            answer = module(*map(torch.from_numpy, feeds.values()))
        return [part.numpy() for part in ((answer,) if isinstance(answer, Tensor) else answer)]

    return run


def spectral_model(
    name: str, *, checkpoint: Path | None = None, random_init: int | None = None
) -> tuple[bytes, nn.Module]:
    """One of the shipped family: as it ships, or with a checkpoint's weights or untrained ones."""
    recipe = read_recipe(name)
    if checkpoint is not None:
        net, recipe = load_spectral(checkpoint, name=name)
    else:
        if random_init is not None:
            training = recipe.training.model_copy(update={"seed": random_init})
            recipe = recipe.model_copy(update={"weights": None, "training": training})
        net = solver_of(recipe, source=name)
    return spectral_file(net, recipe, trained=random_init is None), net


def spectral_file(net: SpectralSolver, recipe: Recipe, *, trained: bool = True) -> bytes:
    """The ONNX file of a recipe's network, with its contract; `trained`: on the pairs of `phasestack train`."""
    return with_contract(spectral_bytes(net, cell_px=recipe.cell_px), spectral_contract(net, recipe, trained=trained))


def spectral_contract(net: SpectralSolver, recipe: Recipe, *, trained: bool = True) -> Contract:
    """What the file of a recipe's network says about itself."""
    return Contract(
        version=2,
        arch="spectral",
        name=recipe.name,
        panels=3,
        eyes=2,
        input_frame="chain",
        input_value="phase",
        layout="RNC",
        eye_order="left-right",
        output="outer",
        branch=2,
        value_range=(0.0, 1.0),
        trained_for=DESIGN_RANGE if trained else None,
        recipe_sha256=recipe.sha256(),
        inputs=ports(network.INPUTS),
        outputs=ports(network.OUTPUTS),
        parameters=_parameters(net),
        cell_px=recipe.cell_px,
        reduction=recipe.reduction,
        emphasis=recipe.emphasis,
        interpolation=recipe.interpolation,
        steps=recipe.steps,
        refining=recipe.refining,
    )


def eyereal_model(
    checkpoint: Path | None,
    *,
    random_init: int | None = None,
    width_px: int,
    height_px: int,
    eye_order: EyeOrder = "left-right",
) -> tuple[bytes, nn.Module]:
    """The published network with a checkpoint's weights, or untrained ones."""
    if checkpoint is not None:
        net = load_eyereal(checkpoint)
        origin = hashlib.sha256(untrusted_input.read_bytes(checkpoint, most_bytes=FILE_BYTES_MAX))
    else:
        torch.manual_seed(random_init or 0)
        net = EyeRealNet().eval()
        origin = hashlib.sha256(f"eyereal 32 random {random_init}".encode())
    data = eyereal_bytes(net, width_px=width_px, height_px=height_px)
    contract = Contract(
        version=2,
        arch="eyereal",
        name="eyereal",
        panels=3,
        eyes=2,
        input_frame="panel",
        input_value="intensity",
        layout="NCHW",
        eye_order=eye_order,
        output="panels",
        branch=1,
        value_range=(-OFFSET, 1 - OFFSET),
        trained_for=None,  # a checkpoint does not tell what it was trained on
        picture_fov_deg=PICTURE_FOV_DEG,
        recipe_sha256=origin.hexdigest(),
        width_px=width_px,
        height_px=height_px,
        inputs=ports((eyereal.INPUT,)),
        outputs=ports((eyereal.OUTPUT,)),
        parameters=_parameters(net),
    )
    return with_contract(data, contract), net


def _parameters(net: nn.Module) -> int:
    return sum(parameter.numel() for parameter in net.parameters())
