"""Reference methods in plain linear algebra: the operator from panel values to phases along rays, and what solves it.

Rows are rays of an eye's image, columns panel pixels, rear to front; a row holds the bilinear weights with which a ray
samples each panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix, hstack

from runtime.optics.malus import phase_from_intensity
from runtime.optics.retina import Mask, panel_positions, ray_mask, sample_bilinear
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F32, F64

TINY = float(np.finfo(np.float64).tiny)
START = 0.5  # every panel's value before a solver begins: the middle of the box


def eye_operator(eye_m: ArrayLike, stack: PanelStack, **view: Any) -> tuple[Any, Mask]:
    """Sparse (rays, N·height·width) of an eye's image (`width_px`, `height_px`, `fov_deg`), and (h, w) its rays: those
    that cross every panel. Raises ValueError where none does."""
    mask = ray_mask(eye_m, stack, **view)
    positions = [panel_positions(eye_m, stack, index=index, **view) for index in range(stack.count)]
    for u, v in positions:
        mask &= (u > 0.5) & (u < stack.width_px - 0.5) & (v > 0.5) & (v < stack.height_px - 0.5)
    if not mask.any():
        raise ValueError("no ray of this eye crosses every panel")
    return hstack([_bilinear(u[mask], v[mask], stack) for u, v in positions], format="csr"), mask


def _bilinear(u: F32, v: F32, stack: PanelStack) -> Any:
    """Sparse (rays, height·width) with the four weights of each ray; positions in pixels, inside the panel."""
    width, height = stack.width_px, stack.height_px
    x, y = u - np.float32(0.5), v - np.float32(0.5)
    column, row = np.minimum(x.astype(np.int32), width - 2), np.minimum(y.astype(np.int32), height - 2)
    fx, fy = x - column, y - row
    first = row * width + column
    pixels = np.stack([first, first + 1, first + width, first + width + 1], axis=-1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=-1)
    return csr_matrix(
        (weights.ravel().astype(np.float32), pixels.ravel(), np.arange(0, 4 * len(u) + 1, 4)),
        shape=(len(u), width * height),
    )


def conjugate_gradients(operator: Any, phases: F32, *, iterations: int) -> F32:
    """Least squares by CG on the normal equations (CGLS, Hestenes and Stiefel 1952), each channel by itself.

    operator: (rays, pixels); phases: (rays, C) of the wanted. Returns (pixels, C) panel values: the iterate that is
    best after clipping to [0, 1]. Where what the eyes should see does not fit into [0, 1], later iterates, clipped,
    are worse than no solving at all.
    """
    layers = np.full((operator.shape[1], phases.shape[1]), START, np.float32)
    residual = phases - operator @ layers
    best, least = layers, _squares(residual).sum()
    gradient = operator.T @ residual
    direction, power = gradient, _squares(gradient)
    for _ in range(iterations):
        moved = operator @ direction
        step = (power / np.maximum(_squares(moved), TINY)).astype(np.float32)
        layers = layers + step * direction
        residual = residual - step * moved
        shown = np.clip(layers, 0, 1)
        left = _squares(phases - operator @ shown).sum()
        if left < least:
            best, least = shown, left
        gradient = operator.T @ residual
        before, power = power, _squares(gradient)
        direction = gradient + (power / np.maximum(before, TINY)).astype(np.float32) * direction
    return best


def _squares(values: F32) -> F64:
    """(C,) sums of squares in double precision."""
    return np.asarray(np.square(values, dtype=np.float64).sum(axis=0))


def mean_of_targets(eyes_m: ArrayLike, wanted: Sequence[F32], stack: PanelStack, *, fov_deg: float) -> F32:
    """Each panel shows a share of the mean of the eyes' target phases, warped on to it: no solving at all.

    wanted: per eye (h, w, C) intensities in [0, 1]. Returns (N, height_px, width_px, C) panel values in [0, 1].
    """
    height, width, channels = wanted[0].shape
    layers = np.zeros((stack.count, stack.height_px, stack.width_px, channels), np.float32)
    u, v = np.arange(stack.width_px) + 0.5, (np.arange(stack.height_px) + 0.5)[:, None]
    for eye, image in zip(np.asarray(eyes_m, dtype=np.float64), wanted, strict=True):
        phase = phase_from_intensity(image.astype(np.float32), 2)
        projection = image_from_stack(eye, width_px=width, height_px=height, fov_deg=fov_deg)
        for index, layer in enumerate(layers):
            h = image_from_raster(projection, stack.panel(index))
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            x, y = ((row[0] * u + row[1] * v + row[2]) / weight for row in h[:2])
            layer += sample_bilinear(phase, u=x.astype(np.float32), v=y.astype(np.float32))
    return np.clip(layers / (len(wanted) * stack.count), 0, 1)
