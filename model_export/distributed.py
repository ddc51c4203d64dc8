"""One process or several of torch's launcher (`torchrun`): who am I, and the mean of all gradients."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import distributed, nn

from runtime.errors import InputError


@dataclass(frozen=True, slots=True)
class World:
    """This process among those that train together."""

    rank: int
    size: int
    device: torch.device

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Every process's gradients become their mean. The model is so small that one message carries all."""
        if self.size == 1:
            return
        held = [p for p in parameters if p.requires_grad]
        flat = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in held])
        distributed.all_reduce(flat)
        flat /= self.size
        for p, part in zip(held, flat.split([p.numel() for p in held]), strict=True):  # type: ignore[no-untyped-call]
            p.grad = part.view_as(p).clone()


@contextmanager
def together(device: str) -> Iterator[World]:
    """Join the launcher's group (gloo on CPUs, nccl on GPUs), or be alone. Raises InputError for a missing device."""
    size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    chosen = chosen_device(device, local)
    if size == 1:
        yield World(0, 1, chosen)
        return
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield World(rank, size, chosen)
    finally:
        distributed.destroy_process_group()


def chosen_device(name: str, local: int = 0) -> torch.device:
    """`auto`: this process's GPU, or the CPU. Raises InputError for what isn't there."""
    if name == "auto":
        name = f"cuda:{local}" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError("train", "--device", f"{name!r} is neither auto, cpu nor cuda") from None
    if device.type not in {"cpu", "cuda"}:
        raise InputError("train", "--device", f"{name!r} is neither auto, cpu nor cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError("train", "--device", f"{name} isn't there: torch sees {torch.cuda.device_count()} GPUs")
    return device
