"""Light and a step of the solver, as differentiable functions in plain torch.

The runtime's kernels are tested against this reference, and networks are trained through it. Equations are those of
docs/mathematics.md, "A step".

*Light.* Panel n shows x_n in [0, 1]. Along a ray, s is the sum of x_n, and the intensity is I = sin²(pi/2·s) =
(1 - Re exp(i·pi·s))/2. A pixel of an eye's picture is a bundle of rays. Within it, the values of different panels are
nearly independent, so that

    E[exp(i·pi·s)] = Z = prod_n z_n,   z_n = sum_q w_nq·exp(i·pi·x_nq)                                        (L1)
    I = (1 - Re Z)/2                                                                                          (L2)

where w_nq is the share of the bundle that pixel q covers on panel n (bilinear weights if the bundle is as wide as a
pixel).

*A step.* With target T and residual e = I - T (0 if a ray misses a panel), consider a common change of all pixels of a
panel that a bundle crosses. The derivative of the squared error, and a bound on its curvature, are sums over all sets:

    g_q = sum w·e·Im Z            (pi/2 times it is the derivative of sum e²/2)                               (L3)
    D_q = sum w·(Im Z)²                                                                                       (L4)
    x' = clip(y - size·2/(pi·N)·g/max(D, floor·E), 0, 1),     y' = x' + momentum·(x' - x)                   (L5)

for N panels and E ray sets. The sum over rays through a panel's pixel (the transpose of bilinear sampling) is computed
as one bilinear sample of the rays' values through the inverse homography. The two agree if the pixels of rays and panel
have equal size, and otherwise differ by a factor that is common to g and D. The edge pixels of pictures are repeated
outwards for two pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from runtime.kernels import EDGE_CLAMP_PX
from runtime.optics.light import panels_from_centre
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack

NEAR_PX = 0.5  # rays count if they are at least this far inside every panel
SIZE = 0.8  # size of steps after a learned network; larger ones overshoot from poor starts
MOMENTUM, FLOOR = 0.7, 0.1
LEAST_ERROR = 1e-6  # minimum squared error, which limits the PSNR to 60 dB


@dataclass(frozen=True, slots=True)
class Views:
    """E sets of rays: for each position of the head, one set for the left eye and one for the right."""

    panels_from_rays: Tensor  # (E, N, 3, 3) float64, from the rays' raster to panel pixels; centres at half-integers
    width_px: int  # of the rays' raster
    height_px: int

    @classmethod
    def of(
        cls,
        stack: PanelStack,
        eyes_m: ArrayLike,
        *,
        width_px: int,
        height_px: int,
        fov_deg: float | None,
        places_m: ArrayLike = ((0.0, 0.0, 0.0),),
    ) -> Views:
        """Return the rays through the pixels of a picture `fov_deg` wide or, if None, of the centre panel.

        eyes_m: (2, 3) left, right, frame `stack`. places_m: displacements of both eyes for further sets, whose rays
        pass through the same points of the centre panel. Raises ValueError for an eye in the centre panel's plane.
        """
        sets = []
        for place in np.asarray(places_m, np.float64):
            for eye in np.asarray(eyes_m, np.float64):
                matrices = panels_from_centre(eye + place, stack)
                if fov_deg is not None:
                    image = image_from_stack(eye, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
                    matrices = matrices @ panel_from_image(image, stack.panel(stack.count // 2))
                sets.append(matrices)
        return cls(torch.from_numpy(np.stack(sets)), width_px, height_px)


def light(panels: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Return intensities (E, C, h, w) of panels (N, C, H, W) by (L1) and (L2), and a mask of rays.

    They are differentiable with respect to the panels, and have the panels' device and dtype.
    """
    bundles, counts = _bundles(panels, views)
    return torch.stack([(1 - reduce(torch.mul, z).real) / 2 for z in bundles]), counts


def traced(
    panels: Tensor, views: Views, *, rays: int = 2, random: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Estimate intensities without bias, and return them with a mask of valid pixels.

    rays: across and down a pixel; each is at a random position in its part of the pixel.
    """
    size, angle = (views.height_px, views.width_px), torch.pi * panels
    total, counts = torch.zeros((), dtype=panels.dtype, device=panels.device), torch.tensor(True, device=panels.device)
    for stratum in range(rays * rays):
        at = torch.tensor([stratum % rays, stratum // rays])[:, None, None]
        within = (torch.rand(2, *size, generator=random, dtype=torch.float64) + at) / rays
        samples = [_sample(angle, m, size, near_px=NEAR_PX, within=within) for m in views.panels_from_rays]
        sums = torch.stack([values.sum(dim=0) for values, _ in samples])
        total = total + (1 - torch.cos(sums)) / (2 * rays * rays)
        counts = counts & torch.stack([inside.all(dim=0) for _, inside in samples])
    return total, counts


def light_db(
    panels: Tensor, targets: Tensor, views: Views, *, rays: int = 3, random: torch.Generator | None = None
) -> float:
    """Return the PSNR of the panels' light at pinhole eyes, against targets (E, C, h, w).

    The errors of two independent sets of rays are multiplied, so that the mean is an unbiased squared error.
    """
    (a, in_a), (b, in_b) = (traced(panels, views, rays=rays, random=random) for _ in range(2))
    counts = in_a & in_b
    error = ((a - targets) * (b - targets) * counts).sum() / (counts.sum() * targets.shape[1])
    return -10 * math.log10(max(float(error), LEAST_ERROR))


def step(
    x: Tensor,
    y: Tensor,
    targets: Tensor,
    views: Views,
    *,
    size: float | Tensor,
    momentum: float | Tensor = MOMENTUM,
    floor: float = FLOOR,
) -> tuple[Tensor, Tensor]:
    """Compute one step (L5): x' and y' from panels x and their extrapolation y, both (N, C, H, W).

    targets: (2, C, h, w) for the left and the right eye. If the views have fewer rows, their head positions take turns
    at the rows of the targets.
    """
    sets, turns = len(views.panels_from_rays), targets.shape[-2] // views.height_px
    back, size_px = torch.linalg.inv(views.panels_from_rays), y.shape[-2:]
    bundles, counts = _bundles(y, views)
    gradient, curvature = torch.zeros_like(y), torch.zeros_like(y)
    for e, z in enumerate(bundles):
        whole, turn = reduce(torch.mul, z), e // 2 if turns > 1 else 0
        error = (1 - whole.real) / 2 - targets[e % 2][:, turn::turns][:, : views.height_px]
        rays = torch.cat([error * whole.imag, whole.imag.square()]) * counts[e]
        g, d = _sample(rays.expand(len(y), -1, -1, -1), back[e], size_px, near_px=-EDGE_CLAMP_PX)[0].chunk(2, dim=1)
        gradient, curvature = gradient + g, curvature + d
    new = (y - size * 2 / (torch.pi * len(y)) * gradient / curvature.clamp(min=floor * sets)).clamp(0, 1)
    return new, new + momentum * (new - x)


def improved(panels: Tensor, targets: Tensor, views: Views, sizes: Sequence[Any], momenta: Sequence[Any]) -> Tensor:
    """Apply one step of each size to the panels."""
    x = y = panels
    for size, momentum in zip(sizes, momenta, strict=True):
        x, y = step(x, y, targets, views, size=size, momentum=momentum)
    return x


def _bundles(panels: Tensor, views: Views) -> tuple[list[Tensor], Tensor]:
    """Return every ray set's z_n, complex (N, C, h, w), and a mask (E, 1, h, w) of rays that count."""
    angle = torch.pi * panels
    parts = torch.cat([torch.cos(angle), torch.sin(angle)], dim=1)  # (N, 2C, H, W)
    bundles, counts = [], []
    for matrices in views.panels_from_rays:
        values, inside = _sample(parts, matrices, (views.height_px, views.width_px), near_px=NEAR_PX)
        bundles.append(torch.complex(*values.chunk(2, dim=1)))
        counts.append(inside.all(dim=0))
    return bundles, torch.stack(counts)


def _sample(
    images: Tensor, matrices: Tensor, size: Sequence[int], *, near_px: float, within: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Sample images (N, K, H, W) to (N, K, h, w) through `matrices` (N, 3, 3) from pixels of the result.

    Samples are bilinear at pixel centres. With `within`, (2, h, w) column and row positions in [0, 1] inside the
    pixels, they are the nearest pixels there. Samples less than `near_px` inside an image are zero; the second result,
    (N, 1, h, w), is a mask of the others.
    """
    height, width = images.shape[-2:]
    to: dict[str, Any] = {"dtype": torch.float64, "device": images.device}
    v, u = torch.meshgrid(torch.arange(size[0], **to), torch.arange(size[1], **to), indexing="ij")
    u, v = torch.stack([u, v]) + (0.5 if within is None else within.to(**to))
    places = torch.einsum("nij,jhw->nihw", matrices.to(images.device), torch.stack([u, v, torch.ones_like(u)]))
    x, y, w = places.unbind(1)
    at = torch.stack([x / w / width, y / w / height], dim=-1)
    margin = torch.tensor([near_px / width, near_px / height], **to)
    inside = ((at >= margin) & (at <= 1 - margin)).all(dim=-1) & (w > 0)
    grid = torch.where(inside[..., None], 2 * at - 1, 0.0).to(images.dtype)
    mode = "bilinear" if within is None else "nearest"
    samples = functional.grid_sample(images, grid, mode, padding_mode="border", align_corners=False)
    return samples * inside[:, None], inside[:, None]
