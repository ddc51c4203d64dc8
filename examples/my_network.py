"""A custom network: a small U-Net that computes three panels from two pictures.

The file must be on Python's path:

    export PYTHONPATH=examples
    phasestack train --arch my_network:MyNetwork --panels panels.json --out out/mine
    phasestack export --arch my_network:MyNetwork --checkpoint out/mine/checkpoint.pth --out mine.onnx
    phasestack solve --model mine.onnx ...

The input (batch, 6, height, width) holds both eyes' pictures, resampled to the centre panel's pixels, as intensities
from 0 to 1 with the left eye first. The output (batch, 9, height, width) holds the panel values from 0 to 1, with the
rear panel first.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from pydantic import BaseModel, Field
from torch import Tensor, nn
from torch.nn import functional


class MyNetwork(nn.Module):
    """U-Net that predicts how each panel deviates from an equal share of the mean picture.

    It works at half the panels' resolution: blocks of 2 by 2 pixels become channels.
    """

    input_frame = "centre"  # alternative: "panel", the pictures resampled to every panel's pixels (18 channels)
    input_value = "intensity"  # alternative: "phase", the sum of panel values that shows the intensity

    class Options(BaseModel):
        """The network's options, set with `--option`.

        They are validated, passed to `__init__` and stored in the checkpoint.
        """

        width: int = Field(32, ge=4, le=256, description="channels on the finest raster")
        levels: int = Field(3, ge=1, le=5, description="coarser rasters")

    def __init__(self, width: int, levels: int) -> None:
        super().__init__()
        widths = [min(width << level, 4 * width) for level in range(levels + 1)]
        self.first = nn.Conv2d(6 * 4, width, 3, padding=1)
        self.down = nn.ModuleList(block(a, b, stride=2) for a, b in pairwise(widths))
        self.up = nn.ModuleList(block(a + b, a) for a, b in pairwise(widths))
        self.last = nn.Conv2d(width, 9 * 4, 1)
        nn.init.zeros_(self.last.weight)  # all panels show the same picture initially
        nn.init.zeros_(self.last.bias)

    def forward(self, eyes: Tensor) -> Tensor:
        x = functional.silu(self.first(functional.pixel_unshuffle(eyes * 2 - 1, 2)))
        skips = []
        for down in self.down:
            skips.append(x)
            x = down(x)
        for up in reversed(self.up):
            skip = skips.pop()
            x = functional.interpolate(x, size=skip.shape[2:], mode="nearest")
            x = up(torch.cat([skip, x], dim=1))
        mean = (eyes[:, :3] + eyes[:, 3:]) / 2
        phase = torch.asin(mean.clamp(1e-4, 1 - 1e-4).sqrt()) * (2 / torch.pi)  # sum of panel values for this intensity
        even = (2 - phase) / 3  # 2 - phase gives the same intensity, and a third is near the middle of a panel's range
        return even.repeat(1, 3, 1, 1) + functional.pixel_shuffle(self.last(x), 2)


def block(channels: int, out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, out, 3, stride=stride, padding=1),
        nn.GroupNorm(1, out),
        nn.SiLU(),
        nn.Conv2d(out, out, 3, padding=1),
        nn.SiLU(),
    )
