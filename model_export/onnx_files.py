"""Convert torch modules to ONNX files that contain a contract."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import onnx
import torch
from torch import nn

from model_export import eyereal, network
from model_export.modules import quiet
from runtime.model.chain import cell_waves, chain_modes
from runtime.model.contract import METADATA_KEY, Contract, Port
from runtime.model.onnx_bytes import digest
from runtime.model.proposal import INPUTS

CELL_AXES = {
    "left": ("rows", "cells", "columns"),
    "right": ("rows", "cells", "columns"),
    "waves": ("cells_and_one", "modes"),
    "shifted_waves": ("cells_and_one", "modes"),
    "spectrum": ("modes",),
    "modes_in": ("modes", "cells"),
    "cell_waves": ("waves_of_cell", "columns_of_cell"),
    "cell_frequencies": ("waves_of_cell",),
    "eye_sigma_px": ("eye_sigmas",),
    "rear": ("rows", "cells_and_one", "columns"),
    "front": ("rows", "cells_and_one", "columns"),
    "check": ("one",),
}
PICTURE_AXES = {name: ("one", "channels", "height", "width") for name in (eyereal.INPUT, eyereal.OUTPUT)}
OPSET = 17
FIXED = {"one", "channels", "eye_sigmas"}


def spectral_bytes(net: nn.Module, *, cell_px: int) -> bytes:
    """Export the spectral solver to an ONNX file that accepts any number of rows, cells and columns."""
    sides = (torch.zeros(16, 8, 6 * cell_px, dtype=torch.int16),) * 2
    modes = tuple(torch.from_numpy(part) for part in (*chain_modes(8), *cell_waves(cell_px)))
    return _exported(net, (*sides, *modes, torch.ones(3)), INPUTS, network.OUTPUTS, CELL_AXES, folded=False)


def ports(names: Sequence[str]) -> tuple[Port, ...]:
    """Return declarations of the named inputs or outputs, as used in a contract."""
    return tuple(Port(name=name, axes=(CELL_AXES | PICTURE_AXES)[name]) for name in names)


def picture_bytes(net: nn.Module, *, channels: int, width_px: int, height_px: int) -> bytes:
    """Export a picture network to an ONNX file for pictures of one size."""
    return _exported(net, (torch.zeros(1, channels, height_px, width_px),), (eyereal.INPUT,), (eyereal.OUTPUT,), {})


def with_contract(data: bytes, contract: Contract) -> bytes:
    """Add a contract to an ONNX file, as the metadata entry that the runtime reads."""
    model = onnx.load_from_string(data)
    del model.metadata_props[:]
    known = digest(model.SerializeToString(deterministic=True))
    contract = contract.model_copy(update={"graph_sha256": known})
    # Only picture networks may have a fixed field of view, so other contracts omit it.
    text = contract.model_dump_json(exclude=None if contract.picture_fov_deg else {"picture_fov_deg"})
    onnx.helper.set_model_props(model, {METADATA_KEY: text})
    return bytes(model.SerializeToString(deterministic=True))


def _exported(
    net: nn.Module,
    example: tuple[Any, ...],
    inputs: Sequence[str],
    outputs: Sequence[str],
    axes: Mapping[str, tuple[str, ...]],
    *,
    folded: bool = True,
) -> bytes:
    """Export a module in evaluation mode to ONNX; dimensions in `axes`, but not in `FIXED`, are variable. If constants
    are not `folded`, the weights keep their names.
    """
    buffer = io.BytesIO()
    with quiet(), torch.no_grad():
        torch.onnx.export(
            net.eval(),
            example,
            buffer,  # type: ignore[arg-type]
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={
                name: {at: axis for at, axis in enumerate(named) if axis not in FIXED} for name, named in axes.items()
            },
            do_constant_folding=folded,
            dynamo=False,
        )
    return buffer.getvalue()
