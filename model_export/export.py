"""Export a model to an ONNX file and check the file (`phasestack export`)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from model_export import eyereal, network
from model_export.checkpoint import FILE_BYTES_MAX, eyereal_width, fill, load_checkpoint
from model_export.eyereal import LEAST_PX, OFFSET
from model_export.modules import PANELS, Network, blamed, check_known, check_static, make_network, probe
from model_export.network import SpectralSolver
from model_export.onnx_files import picture_bytes, ports, spectral_bytes, with_contract
from model_export.recipe import DESIGN_RANGE, read_recipe
from model_export.stress import Feeds
from model_export.validate import Reference, Report, check_model
from runtime.errors import InputError
from runtime.model.contract import Contract, Step
from runtime.model.predictor import SHIPPED
from runtime.model.proposal import INPUTS
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
    options: dict[str, Any] | None = None,
) -> Report:
    """Build a model, check its ONNX file, write it if all checks pass, and return their results.

    `arch` is a shipped model, a picture network, or `module:Class`, whose `options` are its arguments; the other
    arguments are a picture network's: even sizes, and a seed of random weights instead of a checkpoint. Raises
    InputError if they do not fit together, or the network cannot be built or exported.
    """
    check_known(arch, *SHIPPED)
    if checkpoint is not None and random_init is not None:
        raise InputError("export", "--random-init", "cannot be combined with --checkpoint")
    for option, value in (("--width", width_px), ("--height", height_px)):
        if value < LEAST_PX or value > 8192 or value % 2:
            raise InputError("export", option, f"must be an even number from {LEAST_PX} to 8192, not {value}")
    if arch not in SHIPPED:
        network, origin = picture_network(arch, checkpoint, random_init, options or {})
        module = network.net
        size = {"width_px": width_px, "height_px": height_px}
        data = picture_file(network, origin, eye_order=eye_order, **size)
    else:
        if checkpoint is not None or random_init is not None:
            problem = f"{arch} is built from its recipe; omit --checkpoint and --random-init"
            raise InputError("export", "--arch", problem)
        data, module = spectral_model(arch)
    report = check_model(data, source=str(out), reference=in_torch(module))
    if report.passed:
        write_bytes(out, data)
    return report


def in_torch(module: nn.Module) -> Reference:
    """Wrap a torch module for use as the reference that its ONNX file's results are compared with."""

    def run(feeds: Feeds) -> Sequence[np.ndarray]:
        with torch.no_grad():
            answer = module(*map(torch.from_numpy, feeds.values()))
        return [part.numpy() for part in ((answer,) if isinstance(answer, Tensor) else answer)]

    return run


def spectral_model(name: str) -> tuple[bytes, nn.Module]:
    """Build a shipped model from its recipe: the ONNX file with its contract, and the torch module."""
    recipe = read_recipe(name)
    net = SpectralSolver(recipe.cell_px).eval()
    contract = Contract(
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
        trained_for=DESIGN_RANGE,
        recipe_sha256=recipe.sha256(),
        inputs=ports(INPUTS),
        outputs=ports(network.OUTPUTS),
        parameters=_parameters(net),
        cell_px=recipe.cell_px,
        reduction=recipe.reduction,
        steps=recipe.steps,
    )
    return with_contract(spectral_bytes(net, cell_px=recipe.cell_px), contract), net


def picture_network(
    arch: str, checkpoint: Path | None, random_init: int | None, options: dict[str, Any]
) -> tuple[Network, str]:
    """Create a picture network (name or `module:Class`) and a SHA-256 that identifies its weights. These
    are a checkpoint's, or random. `options` for the class override those in a checkpoint from `phasestack train`.
    Raises InputError without weights, or if the checkpoint does not belong to this network.
    """
    if checkpoint is None:
        if random_init is None:
            raise InputError(
                "export", "--checkpoint", f"or --random-init is required because the weights of {arch} are not shipped"
            )
        network = make_network(arch, options, seed=random_init)
        return network, hashlib.sha256(f"{arch} {network.options} random {random_init}".encode()).hexdigest()
    table = load_checkpoint(checkpoint)
    trained = table.get("training")
    if isinstance(trained, dict):
        if trained.get("arch") != arch:
            raise InputError(checkpoint, "training.arch", f"is a checkpoint of {trained.get('arch')}, not {arch}")
        options = {**trained.get("options", {}), **options}
    elif arch == "eyereal":
        options = {"width": eyereal_width(table["model"], source=checkpoint), **options}
    network = make_network(arch, options)
    fill(network.net, table["model"], source=checkpoint, arch=arch)
    data = untrusted_input.read_bytes(checkpoint, most_bytes=FILE_BYTES_MAX)
    return network, hashlib.sha256(data).hexdigest()


def picture_file(
    network: Network, origin: str, *, width_px: int, height_px: int, eye_order: EyeOrder = "left-right"
) -> bytes:
    """Export a picture network, whose contract gets `origin` and the order of eyes, to ONNX for pictures
    of one size. Raises InputError if it fails for pictures of this size, or torch cannot export it.
    """
    form, net, size = network.form, network.net.eval(), {"width_px": width_px, "height_px": height_px}
    probe(network, **size)
    check_static(network, **size)
    with blamed(network.arch, "export"):
        data = picture_bytes(net, channels=form.channels, **size)
    with torch.no_grad():
        steps = tuple(Step(size=float(a), momentum=float(b)) for a, b in zip(*network.steps(), strict=True))
    least = -OFFSET if network.arch == "eyereal" else 0.0
    contract = Contract(
        version=2,
        arch=network.arch,
        name=network.arch.rpartition(":")[2],
        panels=PANELS,
        eyes=2,
        layout="NCHW",
        eye_order=eye_order,
        value_range=(least, 1 + least),
        trained_for=None,  # unknown, because checkpoints do not record it
        recipe_sha256=origin,
        **form.model_dump(exclude={"steps"}),
        steps=steps,
        **size,
        inputs=ports((eyereal.INPUT,)),
        outputs=ports((eyereal.OUTPUT,)),
        parameters=_parameters(net),
    )
    return with_contract(data, contract)


def _parameters(net: nn.Module) -> int:
    return sum(parameter.numel() for parameter in net.parameters())
