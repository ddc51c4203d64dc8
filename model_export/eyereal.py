"""EyeReal's published U-Net, with the parameter names used in the published checkpoints."""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from runtime.config import Section

PICTURE_FOV_DEG = 40.0  # horizontal field of view; outside it, the published code makes the input black
OFFSET = 0.2  # the published code shows sigmoid(y) - 0.2, and the panel clips negative values
INPUT, OUTPUT = "eyes", "panels"
LEAST_PX = 32  # minimum width and height, because the network halves them five times
NORM_MOMENTUM = 0.02  # torch's default of 0.1 would average over only ten pairs, as a batch is often a single pair


def _block(channels: int, middle: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, middle, 3, padding=1, bias=False),
        nn.BatchNorm2d(middle, momentum=NORM_MOMENTUM),
        nn.ReLU(inplace=True),
        nn.Conv2d(middle, out, 3, padding=1, bias=False),
        nn.BatchNorm2d(out, momentum=NORM_MOMENTUM),
        nn.ReLU(inplace=True),
    )


class Up(nn.Module):
    """A decoder stage: double the input, pad it to the skip connection's size, join and convolve."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = _block(channels, channels // 2, out)

    def forward(self, deep: Tensor, skip: Tensor) -> Tensor:
        """Combine features (n, a, h, w) and a skip connection (n, b, H, W) into features (n, out, H, W)."""
        up = functional.interpolate(deep, scale_factor=2, mode="bilinear", align_corners=True)
        rows, columns = skip.shape[2] - up.shape[2], skip.shape[3] - up.shape[3]
        up = functional.pad(up, [columns // 2, columns - columns // 2, rows // 2, rows - rows // 2])
        result: Tensor = self.conv(torch.cat([skip, up], dim=1))
        return result


class UNet(nn.Module):
    """U-Net with five levels; the published network's `subnets` module (17.3 million parameters)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        w = width
        self.in_conv = _block(18, w, w)
        self.down1, self.down2, self.down3, self.down4, self.down5 = (
            nn.Sequential(nn.MaxPool2d(2), _block(a, b, b))
            for a, b in ((w, 2 * w), (2 * w, 4 * w), (4 * w, 8 * w), (8 * w, 16 * w), (16 * w, 16 * w))
        )
        self.up1, self.up2, self.up3, self.up4, self.up5 = (
            Up(a, b) for a, b in ((32 * w, 8 * w), (16 * w, 4 * w), (8 * w, 2 * w), (4 * w, w), (2 * w, w))
        )
        self.out_conv = nn.Sequential(nn.Conv2d(w, 9, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map intensities (n, 18, h, w) to panel values (n, 9, h, w) before the sigmoid."""
        skips = [self.in_conv(x)]
        for down in (self.down1, self.down2, self.down3, self.down4, self.down5):
            skips.append(down(skips[-1]))
        y = skips.pop()
        for up in (self.up1, self.up2, self.up3, self.up4, self.up5):
            y = up(y, skips.pop())
        result: Tensor = self.out_conv(y)
        return result


class EyeRealNet(nn.Module):
    """The published network, which maps the eyes' pictures, resampled for every panel, to panel values.
    The input channels are intensities in [0, 1], ordered by panel, then eye, then RGB. The output channels are ordered
    by panel, then RGB. The outputs are in [-0.2, 0.8], as in the published code, and the panel clips negative values.
    """

    input_frame, input_value, output = "panel", "intensity", "panels"
    picture_fov_deg = PICTURE_FOV_DEG

    class Options(Section):
        """The network's size."""

        width: Annotated[int, Field(ge=1, le=256)] = Field(32, description="number of channels in the first layer")

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.subnets = UNet(width)

    def forward(self, eyes: Tensor) -> Tensor:
        """Map intensities (1, 18, h, w) to panel values (1, 9, h, w)."""
        return torch.sigmoid(self.subnets(eyes)) - OFFSET
