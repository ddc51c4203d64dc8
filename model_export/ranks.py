"""Share a batch among the processes that `torchrun` starts."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed

from runtime.errors import InputError


@dataclass(frozen=True, slots=True)
class Ranks:
    """This process among `count` equal ones, of which the first writes the files."""

    place: torch.device
    rank: int = 0
    count: int = 1

    def mean(self, tensors: Sequence[Tensor]) -> None:
        """Replace every tensor by its mean over the processes, which all must call this."""
        if self.count > 1:
            flat = torch.cat([tensor.detach().flatten() for tensor in tensors])
            distributed.all_reduce(flat)
            parts = torch.split(flat / self.count, [tensor.numel() for tensor in tensors])
            for tensor, part in zip(tensors, parts, strict=True):
                tensor.detach().copy_(part.view_as(tensor))

    def any(self, value: bool) -> bool:
        """Return True if the value is True in any process. All must call this."""
        flag = torch.tensor(float(value), device=self.place)
        self.mean([flag])
        return bool(flag)


@contextmanager
def joined(place: torch.device, batch: int) -> Iterator[Ranks]:
    """Join the processes of `torchrun`, if it started this one. Raises InputError for an unequal share."""
    count = int(os.environ["WORLD_SIZE"]) if distributed.is_torchelastic_launched() else 1
    if batch % count:
        raise InputError("train", "--batch", f"must be a multiple of the {count} processes, not {batch}")
    if count == 1:
        yield Ranks(place)
        return
    distributed.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield Ranks(place, distributed.get_rank(), count)
    finally:
        distributed.destroy_process_group()
