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
from typing import NamedTuple

import numpy as np

from runtime import kernels
from runtime.optics.malus import intensity_from_phase
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import Rays, checked_eye, pupil_points
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.tilt import layer_from_seen, layer_pixels_from_seen
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


class LightView(NamedTuple):
    """An eye's target picture, and the geometry of the rays through its pixels."""

    target: F32  # (h, w, 3) intensities
    centre_from_image: F64  # (3, 3) homography from picture pixels to centre-panel pixels
    panels_from_centre: F64  # (pupil points, N, 3, 3) homographies from centre-panel pixels to each panel's
    toward: F64  # (3,) vector whose dot product with (u, v, 1) is negative for rays towards the panels
    first_ray: int  # number of the view's first ray, used to seed its random positions


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
        view = view_of(side, nominal, true, target, stack, fov_deg=fov_deg, pupil_mm=sampling.pupil_mm)
        rows = range(0, len(target), step * -(-len(target) // (parts * step)))
        calls += [(view, first, last) for first, last in zip(rows, [*rows[1:], len(target)], strict=True)]

    def error(call: tuple[LightView, int, int]) -> tuple[float, int]:
        view, first, last = call
        return _squared_error(codes, view, table, sampling, first, last)

    with ThreadPoolExecutor(cores) as pool:
        sums = np.array(list(pool.map(error, calls)), np.float64)  # (calls, 2): sum of squared errors, number of terms
    if not sums[:, 1].any():
        raise ValueError("no ray from these eyes crosses every panel")
    if sampling.groups:  # each call measured one row
        sums = sums.reshape(len(targets), -1, 2).sum(axis=0)
    groups = [sums[group :: sampling.groups].sum(axis=0) for group in range(sampling.groups)]
    total, counted = np.array([sums.sum(axis=0), *groups]).T
    return np.asarray(total / np.maximum(counted, 1))


def _squared_error(
    codes: U8, view: LightView, table: F32, sampling: Sampling, first: int, last: int
) -> tuple[float, int]:
    """Return the sum of squared errors over the rows from `first` to `last` - 1, and the number of terms."""
    total, counted = kernels.library().squared_error(
        codes, np.ascontiguousarray(view.target, np.float32),
        *(np.ascontiguousarray(x, np.float64) for x in (view.centre_from_image, view.panels_from_centre, view.toward)),
        np.ascontiguousarray(table, np.float32), (view.first_ray, sampling.rays), sampling.step, (first, last),
    )  # fmt: skip
    return total, counted


def view_of(
    side: int, nominal_m: F64, true_m: F64, target: F32, stack: PanelStack, *, fov_deg: float, pupil_mm: float
) -> LightView:
    """Return one eye's target and rays. The eye is a pinhole if `pupil_mm`, its diameter, is 0. Raises
    ValueError if the nominal eye or a point on the true eye's pupil is not in front of every panel.
    """
    height, width = target.shape[:2]
    rays = Rays.of_eye(checked_eye(nominal_m, stack), width_px=width, height_px=height, fov_deg=fov_deg)
    centre = panel_from_image(rays.from_stack, stack.panel(stack.count // 2))
    pupil = pupil_points(pupil_mm / 1e3, rings=RINGS if pupil_mm > 0 else 0)
    ends = [checked_eye(true_m + place, stack) for place in pupil @ stack_from_eye(nominal_m)[:3, :2].T]
    return LightView(target, centre, panels_from_centre(np.array(ends), stack), rays.toward(), first_ray(side))


def first_ray(side: int) -> int:
    """Return the number of an eye's first ray. Eyes share no ray numbers."""
    return side << 40


def panels_from_centre(true_m: F64, stack: PanelStack) -> F64:
    """Return homographies (..., N, 3, 3) from centre-panel to layer pixels along each eye's rays."""
    centre = stack.panel(stack.count // 2)
    matrices = np.stack([centre.to(stack.panel(n), true_m) for n in range(stack.count)], axis=-3)
    if stack.tilt is not None:
        for place in np.ndindex(*matrices.shape[:-2]):
            moved = layer_from_seen(stack, place[-1], true_m[place[:-1]])
            matrices[place] = layer_pixels_from_seen(stack.panel(place[-1]), moved) @ matrices[place]
    return matrices
