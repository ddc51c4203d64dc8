"""What eyes see of the network's own answer, on its raster: the error that training lowers.

Nothing of the runtime is repeated here but where rays meet the panels on that raster: whole columns and a rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model_export.data import CENTRE, TrainingPair
from model_export.network import FULL, SpectralSolver
from model_export.recipe import Recipe
from runtime.model.chain import ChainFrame, chain_frame, chain_modes
from runtime.model.resample import buffer, resample
from runtime.model.transfer import phase_codes, pre_emphasised
from runtime.records import F64

SPREAD = 2.0  # standard deviations to the four places around the nominal one (docs/contracts.md, Error)
WEIGHTS = (0.5, 0.125, 0.125, 0.125, 0.125)


@dataclass(frozen=True, slots=True)
class Sight:
    """A pair on the network's raster."""

    feeds: tuple[Tensor, ...]  # the network's inputs, in its order
    wanted: tuple[Tensor, Tensor]  # per eye (C, rows, columns): phase sums through the centre panel's points
    counts: Tensor  # (rows, columns) True where the panels are
    cell_px: int

    @property
    def doubt(self) -> tuple[float, float, float]:
        """Columns, rows, and the centre panel's own parallax in columns."""
        columns, rows, own = self.feeds[-1].tolist()
        return columns, rows, own


def sight_of(pair: TrainingPair, recipe: Recipe) -> Sight:
    """Raises ValueError where the eyes have no horizontal separation."""
    frame = chain_frame(pair.eyes_m, pair.stack, cell_px=recipe.cell_px, reduction=recipe.reduction)
    height, width = pair.images[0].shape[:2]
    size = (max(1, width // recipe.reduction), max(1, height // recipe.reduction))
    table = phase_codes(2)
    phases = [
        cv2.LUT(cv2.resize(pre_emphasised(image, recipe.emphasis), size, interpolation=cv2.INTER_AREA), table)
        for image in pair.images
    ]
    half = np.asarray(phases[1] - phases[0], np.int16) >> 1
    reduced = np.diag([size[0] / width, size[1] / height, 1.0]) @ pair.stack.panel(CENTRE).raster_from_plane()

    def through(image: np.ndarray, eye_m: F64) -> np.ndarray:
        out = buffer(frame.rows, frame.width_px)
        matrix = reduced @ frame.plane_from_frame(eye_m, x_m=pair.stack.x_m[CENTRE])
        return resample(image, image_from_result=matrix, out=out, result_columns=frame.columns)

    seen = [
        torch.from_numpy(through(need, eye).reshape(frame.rows, frame.cells, -1).copy())
        for need, eye in zip((-half, half), pair.eyes_m, strict=True)
    ]
    modes = [torch.from_numpy(part) for part in chain_modes(frame.cells)]
    doubt = torch.from_numpy(frame.eye_sigma_px(pair.stack, eye_sigma_mm=pair.eye_sigma_mm))
    left, right = (
        torch.from_numpy(through(image, frame.middle_m).astype(np.float32) / FULL).permute(2, 0, 1) for image in phases
    )
    inside = _inside(reduced, frame, pair.stack.x_m[CENTRE], size)
    return Sight((*seen, *modes, doubt), (left, right), torch.from_numpy(inside), recipe.cell_px)


def displayed_mse(net: SpectralSolver, sight: Sight) -> tuple[Tensor, Tensor]:
    """Displayed squared error at the eyes, and expected over their uncertainty. Raises ValueError: nothing is seen."""
    rear, front = (_image(panel, sight) for panel in net.panels(*sight.feeds))
    columns, rows, _ = sight.doubt
    places = [(0.0, 0.0), *((s * SPREAD * columns, 0.0) for s in (-1, 1)), *((0.0, s * SPREAD * rows) for s in (-1, 1))]
    seen = [[_outer(rear, front, sight, side, place) for side in (0, 1)] for place in places]
    centre = ((sight.wanted[0] - seen[0][0] + sight.wanted[1] - seen[0][1]) / 2).clamp(0, 1)
    if not bool(sight.counts.any()):
        raise ValueError("no ray crosses every panel")
    errors = [
        sum(
            (_intensity(outer + centre) - _intensity(sight.wanted[side])).square()[:, sight.counts].mean() / 2
            for side, outer in enumerate(sides)
        )
        for sides in seen
    ]
    expected = sum(weight * error for weight, error in zip(WEIGHTS, errors, strict=True))
    assert isinstance(errors[0], Tensor) and isinstance(expected, Tensor)
    return errors[0], expected


def _outer(rear: Tensor, front: Tensor, sight: Sight, side: int, place: tuple[float, float]) -> Tensor:
    """What an eye sees of both outer panels; beyond the raster's plane everything goes the other way."""
    towards, (columns, rows), own = (-1, 1)[side], place, sight.doubt[2]
    k = sight.cell_px
    size = (int(sight.wanted[0].shape[1]), int(sight.wanted[0].shape[2]))
    through_front = _shifted(front, k + towards * (k + own) + columns, rows, size)
    return through_front + _shifted(rear, k - towards * (k - own) - columns, -rows, size)


def _shifted(panel: Tensor, columns: float, rows: float, size: tuple[int, int]) -> Tensor:
    """(C, h, w) bilinear samples so many columns to the right and rows below."""
    u = (torch.arange(size[1]) + columns + 0.5) * (2 / panel.shape[2]) - 1
    v = (torch.arange(size[0]) + rows + 0.5) * (2 / panel.shape[1]) - 1
    grid = torch.stack([u.expand(size), v[:, None].expand(size)], dim=-1)[None]
    return functional.grid_sample(panel[None], grid, padding_mode="border", align_corners=False)[0]


def _image(panel: Tensor, sight: Sight) -> Tensor:
    """(rows, cells + 1, 2K·C) to (C, rows, columns)."""
    channels = panel.shape[2] // (2 * sight.cell_px)
    return panel.reshape(panel.shape[0], -1, channels).permute(2, 0, 1)


def _intensity(phase: Tensor) -> Tensor:
    return torch.sin(phase * (math.pi / 2)).square()


def _inside(reduced: F64, frame: ChainFrame, x_m: float, size: tuple[int, int]) -> np.ndarray:
    m = reduced @ frame.plane_from_frame(frame.middle_m, x_m=x_m)
    t = frame.columns.homography_from_column(np.arange(frame.width_px) + 0.5)
    x, y, w = (row[0] * t + row[1] * (np.arange(frame.rows) + 0.5)[:, None] + row[2] for row in m)
    inside: np.ndarray = (x > w) & (x < (size[0] - 1) * w) & (y > w) & (y < (size[1] - 1) * w)
    return inside
