"""Reference methods in plain linear algebra: the operator from panel values to phases along rays, and its solvers.

Rows are rays of the eyes' images, columns panel pixels; a row holds the bilinear weights with which a ray samples
each panel. The transpose is exact, so that the normal equations are those of the displayed picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.malus import Branch, phase_from_intensity
from runtime.optics.retina import Mask, panel_positions, ray_mask, sample_bilinear
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F32, U8

TINY = float(np.finfo(np.float64).tiny)
START = 0.5  # every panel's value before a solver begins: the middle of the box


@dataclass(frozen=True, slots=True)
class EyeOperator:
    """What one eye's rays add up: a sparse matrix per panel."""

    panels: tuple[Any, ...]  # N of scipy csr (rays, height·width), rear to front
    mask: Mask  # (h, w) rays that cross every panel; only these are rows

    def phases(self, layers: F32) -> F32:
        """(rays, C) phase sums of (N, height·width, C) panel values."""
        total = self.panels[0] @ layers[0]
        for matrix, layer in zip(self.panels[1:], layers[1:], strict=True):
            total = total + matrix @ layer
        return np.asarray(total)

    def back(self, rays: F32) -> F32:
        """(N, height·width, C): the transpose."""
        return np.stack([matrix.T @ rays for matrix in self.panels])


def bilinear_rows(u: F32, v: F32, *, width_px: int, height_px: int) -> Any:
    """Sparse (rays, height·width) with the four weights of each ray; positions in pixels, inside the panel."""
    from scipy.sparse import csr_matrix

    x, y = u - np.float32(0.5), v - np.float32(0.5)
    column, row = np.minimum(x.astype(np.int32), width_px - 2), np.minimum(y.astype(np.int32), height_px - 2)
    fx, fy = x - column, y - row
    first = row * width_px + column
    indices = np.stack([first, first + 1, first + width_px, first + width_px + 1], axis=-1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=-1)
    starts = np.arange(0, 4 * len(u) + 1, 4, dtype=np.int32)
    return csr_matrix(
        (weights.ravel().astype(np.float32), indices.ravel().astype(np.int32), starts),
        shape=(len(u), width_px * height_px),
    )


def eye_operator(eye_m: ArrayLike, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float) -> EyeOperator:
    """The operator of one eye's image of the given size. Raises ValueError where no ray crosses every panel."""
    positions, mask = _crossings(eye_m, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    if not mask.any():
        raise ValueError("no ray of this eye crosses every panel")
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    return EyeOperator(tuple(bilinear_rows(u[mask], v[mask], **size) for u, v in positions), mask)


def rays_that_count(eye_m: ArrayLike, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float) -> int:
    """How many rows an eye's operator has: rays that cross every panel."""
    return int(_crossings(eye_m, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg)[1].sum())


def _crossings(
    eye_m: ArrayLike, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float
) -> tuple[list[tuple[F32, F32]], Mask]:
    mask = ray_mask(eye_m, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    positions = [
        panel_positions(eye_m, stack, index=index, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
        for index in range(stack.count)
    ]
    for u, v in positions:
        mask &= (u > 0.5) & (u < stack.width_px - 0.5) & (v > 0.5) & (v < stack.height_px - 0.5)
    return positions, mask


def conjugate_gradients(
    operators: Sequence[EyeOperator], wanted: Sequence[F32], stack: PanelStack, *, iterations: int, branch: Branch = 2
) -> F32:
    """Least squares of the phases by CG on the normal equations (CGLS, Hestenes and Stiefel 1952).

    wanted: per eye (h, w, C) intensities in [0, 1]. Returns (N, height_px, width_px, C) panel values: the iterate
    that is best after clipping to [0, 1]. Where what the eyes should see does not fit
    into [0, 1], later iterates, clipped, are worse than no solving at all.
    """
    targets = [
        phase_from_intensity(image[operator.mask].astype(np.float32), branch)
        for operator, image in zip(operators, wanted, strict=True)
    ]
    channels = wanted[0].shape[2]
    layers = np.full((stack.count, stack.height_px * stack.width_px, channels), START, np.float32)
    residuals = [t - operator.phases(layers) for operator, t in zip(operators, targets, strict=True)]
    best, least = layers, _power(residuals)
    gradient = _gather(operators, residuals)
    direction = gradient.copy()
    power = _squares(gradient)
    for _ in range(iterations):
        moved = [operator.phases(direction) for operator in operators]
        curvature = sum(_squares(m) for m in moved)
        step = np.where(curvature > 0, power / np.maximum(curvature, TINY), 0).astype(np.float32)
        layers = layers + step * direction
        residuals = [r - step * m for r, m in zip(residuals, moved, strict=True)]
        shown = np.clip(layers, 0, 1)
        left = residuals
        if np.abs(shown - layers).max() > 1e-3:
            left = [t - operator.phases(shown) for operator, t in zip(operators, targets, strict=True)]
        if _power(left) < least:
            best, least = shown, _power(left)
        gradient = _gather(operators, residuals)
        before, power = power, _squares(gradient)
        direction = gradient + np.where(before > 0, power / np.maximum(before, TINY), 0).astype(np.float32) * direction
    return np.clip(best, 0, 1).reshape(stack.count, stack.height_px, stack.width_px, channels)


def _gather(operators: Sequence[EyeOperator], rays: Sequence[F32]) -> F32:
    total = operators[0].back(rays[0])
    for operator, part in zip(operators[1:], rays[1:], strict=True):
        total += operator.back(part)
    return total


def _power(rays: Sequence[F32]) -> float:
    return float(sum(_squares(part).sum() for part in rays))


def _squares(values: F32) -> Any:
    """Sum of squares per channel, in double precision: channels are problems of their own."""
    flat = values.reshape(-1, values.shape[-1])
    return np.array([np.dot(column, column) for column in flat.T.astype(np.float64)])


def mean_of_targets(
    eyes_m: ArrayLike, wanted: Sequence[F32], stack: PanelStack, *, fov_deg: float, branch: Branch = 2
) -> F32:
    """Each panel shows a share of the mean of the eyes' target phases, warped on to it: no solving at all.

    wanted: per eye (h, w, C) intensities in [0, 1]. Returns (N, height_px, width_px, C) panel values in [0, 1].
    """
    height, width = wanted[0].shape[:2]
    phases = [phase_from_intensity(image.astype(np.float32), branch) for image in wanted]
    layers = np.empty((stack.count, stack.height_px, stack.width_px, wanted[0].shape[2]), np.float32)
    u, v = np.arange(stack.width_px) + 0.5, (np.arange(stack.height_px) + 0.5)[:, None]
    for index in range(stack.count):
        total = np.zeros((stack.height_px, stack.width_px, wanted[0].shape[2]), np.float32)
        for eye, phase in zip(np.asarray(eyes_m, dtype=np.float64), phases, strict=True):
            projection = image_from_stack(eye, width_px=width, height_px=height, fov_deg=fov_deg)
            h = image_from_raster(projection, stack.panel(index))
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            x, y = ((row[0] * u + row[1] * v + row[2]) / weight for row in h[:2])
            total += sample_bilinear(phase, u=x.astype(np.float32), v=y.astype(np.float32))
        layers[index] = total / (len(phases) * stack.count)
    return np.clip(layers, 0, 1)


def as_codes(layers: F32) -> U8:
    """(...) panel values as 8-bit grey levels, rounded to the nearest."""
    return np.rint(layers * 255).astype(np.uint8)
