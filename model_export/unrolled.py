"""A trainable network of solver steps, whose weights are the step sizes and momenta."""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from model_export.light import MOMENTUM, SIZE
from runtime.config import Section


class Unrolled(nn.Module):
    """Network whose only weights are the sizes and momenta of its steps, from panels that are equal."""

    class Options(Section):
        """The number of steps and their initial size."""

        steps: Annotated[int, Field(ge=1, le=64)] = 4
        size: Annotated[float, Field(gt=0, le=3)] = Field(SIZE, description="size of each step before training")

    def __init__(self, steps: int, size: float) -> None:
        super().__init__()
        self.step_sizes = nn.Parameter(torch.full((steps,), size))
        self.step_momenta = nn.Parameter(torch.full((steps,), MOMENTUM))

    def forward(self, eyes: Tensor) -> Tensor:
        """Map intensities (n, 6, h, w) to equal panel values (n, 9, h, w) that show the mean picture."""
        mean = (eyes[:, :3] + eyes[:, 3:]) / 2
        phase = torch.asin(mean.clamp(0, 1).sqrt()) * (2 / torch.pi)
        return ((2 - phase) / 3).repeat(1, 3, 1, 1)
