"""The shipped network: a regularised solver along the eyes' line, closed form but for what it has learned."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

INPUTS = ("difference", "modes_out", "spectrum", "modes_in", "tolerance_mm")
OUTPUT = "front"
START_LAMBDA = 0.03  # the best constant for exact eyes, measured


class SpectralSolver(nn.Module):
    """What the outer panels must carry, from the difference of the eyes' phases, chain by chain.

    g = V·diag(s/(s² + λ(s, tolerance)))·U^T·D with the closed-form modes of the chain operator and a learned
    regularisation λ: how strongly each spatial frequency is driven, given how far off the eyes the picture
    should still hold. Low frequencies (small s) are the stiff ones.
    """

    def __init__(self, hidden: int = 16, start: float = START_LAMBDA) -> None:
        super().__init__()
        last = nn.Linear(hidden, 1)
        self.lambda_net = nn.Sequential(nn.Linear(3, hidden), nn.Tanh(), last)
        nn.init.zeros_(last.weight)
        nn.init.constant_(last.bias, math.log(start))

    def regularisation(self, spectrum: Tensor, tolerance_mm: Tensor) -> Tensor:
        """λ > 0 for singular values (n,) in (0, 4]."""
        s = spectrum / 4
        features = torch.stack([s, torch.sqrt(s), tolerance_mm.expand_as(s) / 4], dim=-1)
        return torch.exp(self.lambda_net(features)[:, 0])

    def forward(
        self, difference: Tensor, modes_out: Tensor, spectrum: Tensor, modes_in: Tensor, tolerance_mm: Tensor
    ) -> Tensor:
        """(rows, cells, columns) phases -> (rows, cells + 1, columns) on the front panel; the rear's is its negative.

        modes_out (cells + 1, cells) V; spectrum (cells,) s; modes_in (cells, cells) U^T; tolerance_mm (1,).
        """
        gain = spectrum / (spectrum * spectrum + self.regularisation(spectrum, tolerance_mm))
        return torch.matmul((modes_out * gain) @ modes_in, difference)
