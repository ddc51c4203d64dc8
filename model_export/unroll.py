"""A differentiable copy of the unrolled prediction (runtime.model.unrolled), and what eyes then see.

The same steps in the same order, sampled exactly where the runtime resamples by OpenCV (1/32 pixel). Rounding to
8 bits passes gradients straight through. Pictures are (1, C, h, w) tensors; phases are in units of one panel's range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from model_export.data import TrainingPair
from model_export.network import SpectralSolver
from model_export.recipe import Recipe
from runtime.model.chain import ChainFrame, chain_frame, chain_modes, relative_tolerance_mm
from runtime.model.resample import target_from_source
from runtime.model.transfer import emphasised
from runtime.optics.malus import HALF_PI
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

REAR, CENTRE, FRONT = 0, 1, 2
START = 0.5
LEVELS = 255.0


def rounded(x: Tensor) -> Tensor:
    """To 8-bit codes; the gradient passes as if nothing had happened."""
    return x + (torch.round(x * LEVELS) / LEVELS - x).detach()


def _size(image: Tensor) -> tuple[int, int]:
    """(h, w) of (1, C, h, w)."""
    return int(image.shape[2]), int(image.shape[3])


def sample(
    image: Tensor,
    image_from_result: F64,
    size: tuple[int, int],
    *,
    mode: str = "bilinear",
    outside: float | None = None,
) -> Tensor:
    """(1, C, h, w) exact samples at the places of a raster; beside the image its edge, or the value `outside`."""
    height, width = size
    m = torch.as_tensor(image_from_result, dtype=torch.float32, device=image.device)
    u = torch.arange(width, device=image.device) + 0.5
    v = (torch.arange(height, device=image.device) + 0.5)[:, None]
    x = (m[0, 0] * u + m[0, 1] * v + m[0, 2]) * (2 / image.shape[3]) - 1
    y = (m[1, 0] * u + m[1, 1] * v + m[1, 2]) * (2 / image.shape[2]) - 1
    grid = torch.stack([x.expand(size), y.expand(size)], dim=-1)[None]
    result = functional.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=False)
    if outside is None:
        return result
    inside = (grid.abs() <= 1).all(dim=-1)[:, None]
    return torch.where(inside, result, result.new_tensor(outside))


class UnrolledSolver(nn.Module):
    """The network and the sizes of the steps: all that is learned."""

    def __init__(self, net: SpectralSolver, recipe: Recipe) -> None:
        super().__init__()
        self.net, self.recipe = net, recipe
        self.kinds = [step.kind for step in recipe.steps]
        self.sizes = nn.Parameter(torch.tensor([step.size for step in recipe.steps]))

    def forward(self, images: Sequence[U8], eyes_m: F64, stack: PanelStack, tolerance_mm: float) -> Tensor:
        """(3, 3, h, w) panel values, rear to front, as 8 bits show them. Raises ValueError for eyes it can't serve."""
        recipe, device = self.recipe, self.sizes.device
        frame = chain_frame(eyes_m, stack, cell_px=recipe.cell_px, reduction=recipe.reduction)
        pictures = [emphasised(image, recipe.emphasis) for image in images]
        tolerance = torch.tensor([relative_tolerance_mm(tolerance_mm, eyes_m)], dtype=torch.float32, device=device)
        level = _Level(pictures, eyes_m, stack, recipe.steps[0].reduction, device)
        for index, step in enumerate(recipe.steps):
            if step.reduction != level.reduction:
                level = level.refined(pictures, step.reduction)
            lacks = level.lacks() if index else []
            if step.kind == "chain":
                needs = lacks or _first_needs(pictures, recipe.reduction, device)
                factor = recipe.reduction // level.reduction if lacks else 1
                coarse = [functional.avg_pool2d(need, factor) for need in needs] if factor > 1 else needs
                change = self._chain(coarse, frame, level, tolerance)
            else:
                n = FRONT if step.kind == "front" else REAR
                change = {n: level.correction(lacks, n)}
            level.add({n: self.sizes[index] * value for n, value in change.items()})
        if level.reduction > 1:
            level = level.refined(pictures, 1)
        return level.layers()

    def _chain(self, needs: Sequence[Tensor], frame: ChainFrame, level: _Level, tolerance: Tensor) -> dict[int, Tensor]:
        """The network's change of both outer panels."""
        stack, eyes_m = level.stack, level.eyes_m
        height, width = _size(needs[0])
        reduced = np.diag([width / stack.width_px, height / stack.height_px, 1.0])
        reduced_from_plane = reduced @ stack.panel(CENTRE).raster_from_plane()
        size = (frame.rows, frame.width_px)
        left, right = (
            sample(need, reduced_from_plane @ frame.plane_from_frame(eye, x_m=stack.x_m[CENTRE]), size, outside=0.0)
            for need, eye in zip(needs, eyes_m, strict=True)
        )
        columns = (right - left)[0].permute(1, 2, 0).reshape(frame.rows, frame.cells, -1)
        modes = (torch.from_numpy(part).to(columns.device) for part in chain_modes(frame.cells))
        answer = self.net(columns, *modes, tolerance)
        wave = answer.reshape(frame.rows, -1, 3).permute(2, 0, 1)[None]
        change = {}
        for n, sign in ((REAR, -1.0), (FRONT, 1.0)):
            panel = stack.panel(n)
            matrix = frame.frame_from_plane(x_m=panel.x_m) @ panel.plane_from_raster()
            matrix[0, 2] += frame.cell_px
            straight = matrix[0, 1] == 0.0 and matrix[1, 0] == 0.0
            mode = "bicubic" if straight else "bilinear"
            change[n] = sign * sample(wave, matrix, (stack.height_px, stack.width_px), mode=mode, outside=0.0)
        return change


class _Level:
    """The panels on a raster, whole or coarser (runtime.model.level)."""

    def __init__(
        self, pictures: Sequence[U8], eyes_m: F64, stack: PanelStack, reduction: int, device: torch.device
    ) -> None:
        self.reduction, self.eyes_m, self.whole = reduction, eyes_m, stack
        self.stack = replace(
            stack, width_px=max(1, stack.width_px // reduction), height_px=max(1, stack.height_px // reduction)
        )
        self.wanted = [_averaged(picture, reduction, device) for picture in pictures]
        self.outer = {n: torch.full_like(self.wanted[0], START) for n in (REAR, FRONT)}
        self.seen: dict[tuple[int, int], Tensor] = {}

    def refined(self, pictures: Sequence[U8], reduction: int) -> _Level:
        """The same outer panels on a finer raster."""
        finer = _Level(pictures, self.eyes_m, self.whole, reduction, self.wanted[0].device)
        size = _size(finer.wanted[0])
        for n, coarse in self.outer.items():
            enlarged = functional.interpolate(coarse, size=size, mode="bicubic", align_corners=False)
            finer.outer[n] = rounded(enlarged.clamp(0, 1))
        finer.look((REAR, FRONT))
        return finer

    def look(self, panels: Sequence[int]) -> None:
        for n in panels:
            for side, eye in enumerate(self.eyes_m):
                matrix = target_from_source(eye, source=self.stack.panel(CENTRE), target=self.stack.panel(n))
                self.seen[n, side] = sample(self.outer[n], matrix, _size(self.outer[n]), outside=START)

    def lacks(self) -> list[Tensor]:
        left, right = self._unclosed()
        best = ((left + right) / 2).clamp(0, 1)
        return [left - best, right - best]

    def correction(self, lacks: Sequence[Tensor], panel: int) -> Tensor:
        back = []
        for lack, eye in zip(lacks, self.eyes_m, strict=True):
            matrix = target_from_source(eye, source=self.stack.panel(panel), target=self.stack.panel(CENTRE))
            back.append(sample(lack, matrix, _size(lack), outside=0.0))
        return back[0] + back[1]

    def add(self, change: dict[int, Tensor]) -> None:
        for n, value in change.items():
            self.outer[n] = rounded((self.outer[n] + value).clamp(0, 1))
        self.look(tuple(change))

    def layers(self) -> Tensor:
        left, right = self._unclosed()
        return torch.cat([self.outer[REAR], rounded(((left + right) / 2).clamp(0, 1)), self.outer[FRONT]])

    def _unclosed(self) -> tuple[Tensor, Tensor]:
        left, right = (self.wanted[side] - self.seen[REAR, side] - self.seen[FRONT, side] for side in (0, 1))
        return left, right


def _averaged(picture: U8, reduction: int, device: torch.device) -> Tensor:
    """Phase sums of a picture at fewer pixels: averaged as intensities, as the runtime does."""
    intensity = torch.from_numpy(np.ascontiguousarray(picture)).to(device).float().permute(2, 0, 1)[None] / LEVELS
    coarse = functional.avg_pool2d(intensity, reduction) if reduction > 1 else intensity
    return 2 - torch.asin(torch.sqrt(coarse)) / HALF_PI


def _first_needs(pictures: Sequence[U8], reduction: int, device: torch.device) -> list[Tensor]:
    """What each eye lacks while the outer panels are even."""
    left, right = (_averaged(picture, reduction, device) for picture in pictures)
    half = (right - left) / 2
    return [-half, half]


def seen_error(layers: Tensor, image: U8, eye_m: F64, stack: PanelStack) -> tuple[Tensor, int]:
    """Squared error of what an eye sees through the centre panel's pixels, summed, and how many values count.

    Displayed: sin² of the summed panel values, over rays that cross every panel half a pixel inside its edge.
    """
    height, width = image.shape[:2]
    total = layers[CENTRE][None]
    u, v = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    counts = (u > 1) & (u < width - 1) & (v > 1) & (v < height - 1)
    for n in (REAR, FRONT):
        matrix = target_from_source(eye_m, source=stack.panel(CENTRE), target=stack.panel(n))
        total = total + sample(layers[n][None], matrix, (height, width))
        x, y = matrix[0, 0] * u + matrix[0, 2], matrix[1, 1] * v + matrix[1, 2]
        counts = counts & (x > 0.5) & (x < width - 0.5) & (y > 0.5) & (y < height - 0.5)
    wanted = torch.from_numpy(np.ascontiguousarray(image)).to(total.device).float().permute(2, 0, 1)[None] / LEVELS
    mask = torch.from_numpy(counts).to(total.device)
    squared = (torch.sin(total * (math.pi / 2)) ** 2 - wanted).square() * mask
    return squared.sum(), int(counts.sum()) * 3


def displayed_mse(layers: Tensor, pair: TrainingPair) -> tuple[Tensor, Tensor]:
    """Mean squared error at the eyes, and beside them (equal to the first where the pair has no such views).

    Raises ValueError where no ray of an eye crosses every panel.
    """
    exact = [seen_error(layers, image, eye, pair.stack) for image, eye in zip(pair.images, pair.eyes_m, strict=True)]
    off = [seen_error(layers, place.image, place.eye_m, pair.stack) for place in pair.off]
    return _mean(exact), _mean(off or exact)


def _mean(parts: Sequence[tuple[Tensor, int]]) -> Tensor:
    count = sum(n for _, n in parts)
    if count == 0:
        raise ValueError("no ray crosses every panel")
    total = parts[0][0]
    for value, _ in parts[1:]:
        total = total + value
    return total / count
