"""Mean squared error of the light that reaches the eyes through the displayed layers.

docs/contracts.md ("Error") defines it. *Light*, the figure to quote, is the mean over the pixel and the pupil,
estimated from two independent sets of random rays: the mean product of the two sets' errors is unbiased, whereas a
single set's mean square would include the variance of the rays. *One ray*, as in published evaluations, goes through
the centres of the pixel and the pupil, and samples the panels bilinearly.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime import kernels
from runtime.optics.malus import intensity_from_phase
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import ImageRays, checked_eye, pupil_points
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.tilt import seen_on_layers
from runtime.optics.views import stack_from_eye
from runtime.records import F32, F64, U8, Eyes

RINGS = 9  # rings of points on the pupil; these 271 points are as good as a disc


class Sampling(NamedTuple):
    """Choice of the rays used to measure the squared error."""

    rays: int = 2  # rays across and down a pixel, in each of two sets; 0: a single ray, sampled bilinearly
    pupil_mm: float = PUPIL_MM  # pupil diameter; 0: a pinhole
    step: int = 1  # only every `step`-th pixel of every `step`-th row is measured
    groups: int = 0  # number of groups of rows, used to estimate the standard error


LIGHT = Sampling()
ONE_RAY = Sampling(rays=0, pupil_mm=0.0)


def squared_errors(
    layers: U8,
    targets: Sequence[F32],
    stack: PanelStack,
    *,
    solved_for_m: Eyes,
    eyes_m: Eyes,
    fov_deg: float,
    sampling: Sampling,
) -> F64:
    """Return the mean squared errors (1 + groups,) of the light that reaches the eyes, compared with
    carried targets.

    A carried target is a picture treated as if it were painted on the centre panel (docs/contracts.md). A pixel counts
    if all its rays cross every panel at least half a pixel inside the panel's edge. The first error is over all rows,
    and the others over interleaved groups of rows; their scatter gives the standard error. An error of nearly perfect
    light can be negative because the rays are random.

    Raises ValueError if an eye is not in front of every panel, or no pixel counts.
    """
    cores, step = len(os.sched_getaffinity(0)), sampling.step
    parts = -(-min(len(target) for target in targets) // step) if sampling.groups else 4 * cores
    codes = np.ascontiguousarray(layers)
    fine = 1 if sampling.rays else kernels.TABLE_STEPS
    table = intensity_from_phase(np.arange(255 * fine * stack.count + 1, dtype=np.float32) / np.float32(255 * fine))
    calls = []
    for side, (nominal, true, target) in enumerate(zip(solved_for_m, eyes_m, targets, strict=True)):
        view = _view(nominal, true, target, stack, fov_deg=fov_deg, pupil_mm=sampling.pupil_mm)
        rays = side << 40, sampling.rays  # eyes share no numbers of rays, which seed their random positions
        rows = range(0, len(target), step * -(-len(target) // (parts * step)))
        calls += [(codes, *view, table, rays, step, part) for part in pairwise([*rows, len(target)])]

    with ThreadPoolExecutor(cores) as pool:
        # (calls, 2): sum of squared errors, number of terms
        sums = np.array(list(pool.map(lambda call: kernels.library().squared_error(*call), calls)), np.float64)
    if not sums[:, 1].any():
        raise ValueError("no ray from these eyes crosses every panel")
    if sampling.groups:  # each call measured one row
        sums = sums.reshape(len(targets), -1, 2).sum(axis=0)
    groups = [sums[group :: sampling.groups].sum(axis=0) for group in range(sampling.groups)]
    total, counted = np.array([sums.sum(axis=0), *groups]).T
    return np.asarray(total / np.maximum(counted, 1))


def _view(
    nominal_m: F64, true_m: F64, target: F32, stack: PanelStack, *, fov_deg: float, pupil_mm: float
) -> tuple[NDArray[np.floating[Any]], ...]:
    """Return an eye's target and rays as `kernels.squared_error` takes them: the homographies from the picture to the
    centre panel, and from there to each layer for each point of the pupil, and `ImageRays.toward`. Raises ValueError if
    the nominal eye or a point on the true eye's pupil is not in front of every panel.
    """
    height, width = target.shape[:2]
    rays = ImageRays.of_eye(checked_eye(nominal_m, stack), width_px=width, height_px=height, fov_deg=fov_deg)
    centre = panel_from_image(rays.image_from_stack, stack.panel(stack.count // 2))
    pupil = pupil_points(pupil_mm / 1e3, rings=RINGS if pupil_mm > 0 else 0)
    ends = [checked_eye(true_m + place, stack) for place in pupil @ stack_from_eye(nominal_m)[:3, :2].T]
    homographies = (np.ascontiguousarray(x) for x in (centre, panels_from_centre(np.array(ends), stack), rays.toward))
    return np.ascontiguousarray(target, np.float32), *homographies


def panels_from_centre(true_m: F64, stack: PanelStack) -> F64:
    """Return homographies (..., N, 3, 3) from centre-panel to layer pixels along each eye's rays."""
    centre = stack.panel(stack.count // 2)
    matrices = np.stack([centre.to(stack.panel(n), true_m) for n in range(stack.count)], axis=-3)
    return seen_on_layers(matrices, stack, true_m)
