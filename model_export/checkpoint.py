"""Read and write checkpoints. Only weights are read, so that a checkpoint cannot run code."""

from __future__ import annotations

import argparse
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from runtime.errors import InputError, one_line
from runtime.support import untrusted_input
from runtime.support.artifacts import write_bytes

FILE_BYTES_MAX = 4 << 30  # maximum size of a checkpoint
WIDTH_KEY = "subnets.in_conv.0.weight"


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint: a dictionary whose `model` entry is a state dictionary of tensors. Only plain
    values, tensors and an `argparse.Namespace` of plain values (which the published code saves) are deserialised.
    Raises InputError if the file cannot be read, contains other objects, or has no `model` entry.
    """
    data = untrusted_input.read_bytes(path, most_bytes=FILE_BYTES_MAX)
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            table: dict[str, Any] = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle can raise anything
        raise InputError(path, "", f"is not a checkpoint of plain weights: {one_line(str(error), most=120)}") from None
    state = table.get("model") if isinstance(table, dict) else None
    if not isinstance(state, Mapping) or not state or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(path, "model", 'is missing; a checkpoint must have the form {"model": state_dict}')
    return table


def eyereal_width(state: Mapping[str, Tensor], *, source: Path) -> int:
    """Channels of a published network's first layer, by its weights. Raises InputError for other weights."""
    first = state.get(WIDTH_KEY)
    if first is None or first.ndim != 4:
        raise InputError(source, WIDTH_KEY, "is missing, so this is not a checkpoint of the published network")
    return int(first.shape[0])


def fill(net: nn.Module, state: Mapping[str, Tensor], *, source: str | Path, arch: str) -> None:
    """Load weights by name into a network. Raises InputError, which names the weight at fault."""
    expected = net.state_dict()
    missing = [key for key in expected if key not in state]
    # Old checkpoints lack this counter, which is not used for inference.
    missing = [key for key in missing if not key.endswith("num_batches_tracked")]
    surplus = [key for key in state if key not in expected]
    if missing or surplus:
        problem = [f"{len(missing)} keys of {arch} are missing"] if missing else []
        problem += [f"{len(surplus)} keys do not belong to {arch}"] if surplus else []
        raise InputError(source, (missing or surplus)[0], "; ".join(problem))
    for key, value in state.items():
        if value.shape != expected[key].shape:
            shapes = f"has shape {tuple(value.shape)}, but {arch} requires {tuple(expected[key].shape)}"
            raise InputError(source, key, shapes)
        if not torch.isfinite(value).all():
            raise InputError(source, key, "contains numbers that are not finite")
    net.load_state_dict({**expected, **state})


def save_checkpoint(path: Path, table: dict[str, Any]) -> None:
    """Write a checkpoint atomically. The dictionary may contain only values that `load_checkpoint` reads."""
    buffer = io.BytesIO()
    torch.save(table, buffer)
    write_bytes(path, buffer.getvalue())
