"""Modules that can't be served, one reason each. `FAULTS`: their messages."""

from __future__ import annotations

from typing import Any

import torch
from pydantic import BaseModel, Field
from torch import nn

FAULTS = {
    "absent:Module": "`absent` cannot be imported: ",
    "tests.model_export.unservable:Absent": "is not a class derived from torch.nn.Module",
    "tests.model_export.unservable:WrongInput": "expected input",
    "tests.model_export.unservable:WrongOutput": "channels (3 panels of 3 colours)",
    "tests.model_export.unservable:HalfSize": "height (3 panels of 3 colours)",
    "tests.model_export.unservable:NotFinite": "forward: returns numbers that are not finite",
    "tests.model_export.unservable:NeedsGpu": "forward",
    "tests.model_export.unservable:Branches": "branches on the values of its input",
    "tests.model_export.unservable:Fourier": "aten::fft_rfft2",
    "tests.model_export.unservable:Leaves": "SystemExit",
    "tests.model_export.unservable:OtherFrame": "input_frame",
    "tests.model_export.unservable:Narrow": "--option: width",
}


class Even(nn.Module):
    """All panels show the mean: this one can be served."""

    def __init__(self) -> None:
        super().__init__()
        self.strength = nn.Parameter(torch.tensor(1.0))

    def forward(self, eyes: Any) -> Any:
        return (eyes[:, :3] + eyes[:, 3:6]).repeat(1, 3, 1, 1) * (self.strength / 6)


class WrongInput(Even):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(18, 9, 3, padding=1)

    def forward(self, eyes: Any) -> Any:
        return self.conv(eyes)


class WrongOutput(Even):
    def forward(self, eyes: Any) -> Any:
        return super().forward(eyes)[:, :6]


class HalfSize(Even):
    def forward(self, eyes: Any) -> Any:
        return super().forward(eyes)[:, :, ::2]


class NotFinite(Even):
    def forward(self, eyes: Any) -> Any:
        return super().forward(eyes) / torch.zeros(1)


class NeedsGpu(Even):
    def forward(self, eyes: Any) -> Any:
        return super().forward(eyes.cuda()).cpu()


class Branches(Even):
    def forward(self, eyes: Any) -> Any:
        panels = super().forward(eyes)
        return panels * 2 if eyes.mean() > 0.9 else panels


class Fourier(Even):
    def forward(self, eyes: Any) -> Any:
        waves = torch.fft.rfft2(super().forward(eyes))
        return torch.fft.irfft2(waves, s=eyes.shape[2:])


class Leaves(Even):
    def forward(self, eyes: Any) -> Any:
        raise SystemExit(3)


class OtherFrame(Even):
    input_frame = "chain"


class Narrow(Even):
    class Options(BaseModel):
        width: int = Field(ge=4)
