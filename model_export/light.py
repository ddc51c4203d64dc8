"""Compute the light at the eyes, and the solver's steps, as differentiable torch functions.

Networks are trained by backpropagating through these functions, and the runtime is tested against them. The equations
are the ones in docs/mathematics.md, "A step". The functions mirror these, which they share only homographies with:

    Views.of   of pictures: optics/light.py, squared_errors; of steps: model/geometry.py, Geometry.ray_sets
    light      kernels/solver.cpp, to_phasors and compare; model/gl/shaders/compare.frag.glsl
    step       kernels/solver.cpp, step; model/gl/shaders/compare.frag.glsl, sets.glsl and move.frag.glsl
    improved   model/solver.py, StepPredictor.solve, from a network's panels
    traced     kernels/light.cpp, see; optics/retina.py, through_layers of boxes; browser/assets/display.js
    light_db   optics/light.py, squared_errors, for pinhole eyes

*Light.* Panel n shows x_n in [0, 1]. Along a ray, s is the sum of x_n, and the intensity is I = sin²(pi/2·s) =
(1 - Re exp(i·pi·s))/2. A pixel of an eye's picture is a bundle of rays. Within a bundle, the values on different panels
are nearly independent. Therefore

    E[exp(i·pi·s)] = Z = prod_n z_n,   z_n = sum_q w_nq·exp(i·pi·x_nq)                                        (L1)
    I = (1 - Re Z)/2                                                                                          (L2)

where w_nq is the share of the bundle covered by pixel q on panel n. The shares are bilinear weights if the bundle is as
wide as a pixel.

*A step.* Let T be the target and e = I - T the residual, which is 0 if a ray misses a panel. Consider changing, by the
same amount, all of a panel's pixels that a bundle crosses. The derivative of the squared error, and a bound on its
curvature, are then sums over all sets of rays:

    g_q = sum w·e·Im Z            (pi/2·g is the derivative of sum e²/2)                                      (L3)
    D_q = sum w·(Im Z)²                                                                                       (L4)
    x' = clip(y - size·2/(pi·N)·g/max(D, floor·E), 0, 1),     y' = x' + momentum·(x' - x)                   (L5)

for N panels and E sets of rays. The sum over the rays through a panel's pixel is the transpose of bilinear sampling. It
is approximated by one bilinear sample of the rays' values through the inverse homography. The approximation is exact if
the picture's pixels and the panel's pixels have the same size. Otherwise, g and D are off by the same factor, which
cancels out. The edge pixels of a picture are extended outwards by two pixels.
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

NEAR_PX = 0.5  # a valid ray passes at least this far inside every panel's edges
SIZE = 0.8  # size of the steps that follow a trained network; larger steps overshoot when the initial values are poor
MOMENTUM, FLOOR = 0.7, 0.1
LEAST_ERROR = 1e-6  # minimum squared error, which limits the PSNR to 60 dB


@dataclass(frozen=True, slots=True)
class Views:
    """Both eyes' rays through the pixels of a raster, as homographies to the panels.

    Each of the E sets of rays belongs to one view. The sets list all views for each head position in turn.
    """

    panels_from_rays: Tensor  # (E, N, 3, 3) float64, from raster to panel pixels; pixel centres at half-integers
    width_px: int  # width of the raster
    height_px: int  # height of the raster
    views: tuple[int, ...] = ()  # each set's view, if the sets do not list all views in turn
    turn: tuple[int, ...] = ()  # likewise, the rows that belong to the set: every `turns`-th from this one

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
        """Create the rays of two eyes (2, 3) in the `stack` frame through the pixels of their pictures.

        Without a horizontal field of view, the raster is the middle panel's. Each displacement (P, 3) of both eyes adds
        two sets of rays, through the same points on the middle panel. Raises ValueError if an eye is in its plane.
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
    """Compute the intensities (E, C, h, w) at the eyes from (L1) and (L2), with a mask of rays.

    The panel values (N, C, H, W) are in [0, 1]; the intensities are differentiable with respect to them. The mask
    (E, 1, h, w) is of the rays that cross all panels.
    """
    bundles, counts = _bundles(panels, views)
    return torch.stack([(1 - reduce(torch.mul, z).real) / 2 for z in bundles]), counts


def traced(
    panels: Tensor, views: Views, *, rays: int = 2, random: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Estimate the intensities of `light` without bias by tracing random rays.

    A pixel is divided into rays² equal parts, and each ray is at a random position in one part. The mask is of the
    pixels whose rays all cross all panels.
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
    """Return the PSNR, in dB, of the light at pinhole eyes for target intensities (E, C, h, w).

    The error is estimated twice, with independent rays, `rays` across and down a pixel each time. The mean product of
    the two estimates is an unbiased estimate of the squared error.
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
    grey: Sequence[int] = (),
) -> tuple[Tensor, Tensor]:
    """Compute one solver step from (L5): the new panel values x' (N, C, H, W) and their extrapolation y'.

    `y` is extrapolated from x by the previous step's momentum; initially it equals x. If the targets (V, C, h, w) of
    the views have k times as many rows as the rays, the sets take k turns, and each uses every k-th row. Panels in
    `grey` have one value for all channels: their gradient and curvature are means over the channels.
    """
    sets, turns = len(views.panels_from_rays), targets.shape[-2] // views.height_px
    back, size_px = torch.linalg.inv(views.panels_from_rays), y.shape[-2:]
    bundles, counts = _bundles(y, views)
    gradient, curvature = torch.zeros_like(y), torch.zeros_like(y)
    for e, z in enumerate(bundles):
        whole = reduce(torch.mul, z)
        turn = views.turn[e] if views.turn else e // len(targets) if turns > 1 else 0
        view = views.views[e] if views.views else e % len(targets)
        error = (1 - whole.real) / 2 - targets[view][:, turn::turns][:, : views.height_px]
        rays = torch.cat([error * whole.imag, whole.imag.square()]) * counts[e]
        g, d = _sample(rays.expand(len(y), -1, -1, -1), back[e], size_px, near_px=-EDGE_CLAMP_PX)[0].chunk(2, dim=1)
        gradient, curvature = gradient + g, curvature + d
    for n in grey:
        gradient[n], curvature[n] = gradient[n].mean(dim=0), curvature[n].mean(dim=0)
    new = (y - size * 2 / (torch.pi * len(y)) * gradient / curvature.clamp(min=FLOOR * sets)).clamp(0, 1)
    return new, new + momentum * (new - x)


def improved(panels: Tensor, targets: Tensor, views: Views, sizes: Sequence[Any], momenta: Sequence[Any]) -> Tensor:
    """Apply a solver step of each size and momentum to the initial panels."""
    x = y = panels
    for size, momentum in zip(sizes, momenta, strict=True):
        x, y = step(x, y, targets, views, size=size, momentum=momentum)
    return x


def _bundles(panels: Tensor, views: Views) -> tuple[list[Tensor], Tensor]:
    """Return the complex values z_n (N, C, h, w) of (L1) for each set of rays, and the mask of `light`."""
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
    """Resample images (N, K, H, W) through homographies (N, 3, 3) from the result's pixels (h, w) to theirs.

    Samples nearer than `near_px` (which may be negative) to an image's edges are zero and not valid; the mask
    (N, 1, h, w) is of the valid ones. They are bilinear at pixel centres, or the nearest pixels at column and row
    positions `within` (2, h, w) the result's pixels, in [0, 1].
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
