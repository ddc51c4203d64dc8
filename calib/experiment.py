"""The EyeReal's synthetic experiment (section 2.3), repeated for every method: error at the eye against noise."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.eye_separation import SeparationScale, joined, separation_scale
from calib.robust import fit_robust
from calib.scale_prior import posterior_scale
from calib.similarity import ScaleRule, Similarity, fit, fit_batch
from calib.solution import METHODS, SCALE_SIGMA, design_covariance
from calib.viewpoints import IPD_M, grid, viewing_volume_m
from runtime.records import F64

SIGMAS_M = (0.0, 0.001, 0.003, 0.010, 0.030)
CAMERA_M = (0.05, 0.02, 0.22)
EYE_NOISE_M = 0.001  # of each eye's coordinate in the mean over half a second
OUTLIER_SHARE = 0.2
OUTLIER_M = (0.10, 0.50)
DEFAULT = "default"


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table."""

    sigma_m: float  # noise of each coordinate on the sensor's side
    sensor_scale: float  # metres of `stack` for one metre that the sensor tells
    outliers: bool
    mean_m: dict[str, float]  # of the error at the eye, by method
    p95_m: dict[str, float]
    rms_residual_m: dict[str, float]  # in `stack`, the root of the mean over samples of the mean square


def run_case(
    *,
    sigma_m: float,
    sensor_scale: float = 1.0,
    outliers: bool = False,
    seeds: int = 200,
    start: int = 0,
    separation_sigma_m: float = 0.0,
) -> Case:
    """27 viewpoints, `seeds` noise samples, each with a camera that is turned at random.

    The error is taken where viewers are (`viewing_volume_m`), of points that the sensor would tell without noise,
    so that it is the calibration's alone. separation_sigma_m: how exactly the viewer's own eye separation is known; the
    noise is then of where the head is, and each eye has `EYE_NOISE_M` besides; 0: not known.
    """
    known_m, volume_m = np.array([viewpoint.midpoint_m for viewpoint in grid()]), viewing_volume_m()
    random = np.random.default_rng(start)
    rotation = Rotation.random(seeds, rng=random).as_matrix()
    exact = ((known_m - CAMERA_M)[None] @ rotation) / sensor_scale
    sensor = exact + random.normal(scale=sigma_m or 1.0, size=exact.shape) * (sigma_m > 0)
    if outliers:
        sensor += _gross_errors(seeds, len(known_m), random)
    seen = ((volume_m - CAMERA_M)[None] @ rotation) / sensor_scale
    stack = np.broadcast_to(known_m, sensor.shape)
    fits = _all_fits(sensor, stack, _separations(seeds, sensor_scale, separation_sigma_m, random))
    errors = {name: np.linalg.norm(s.points(seen) - volume_m, axis=-1) for name, s in fits.items()}
    residuals = {name: ((s.points(sensor) - stack) ** 2).sum(-1).mean() for name, s in fits.items()}
    return Case(
        sigma_m,
        sensor_scale,
        outliers,
        {name: float(e.mean()) for name, e in errors.items()},
        {name: float(np.percentile(e, 95)) for name, e in errors.items()},
        {name: float(np.sqrt(r)) for name, r in residuals.items()},
    )


def _gross_errors(seeds: int, count: int, random: np.random.Generator) -> F64:
    wrong = np.argsort(random.random((seeds, count)), axis=1) < round(OUTLIER_SHARE * count)
    direction = random.normal(size=(seeds, count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return direction * (random.uniform(*OUTLIER_M, size=(seeds, count)) * wrong)[..., None]


def _separations(
    seeds: int, sensor_scale: float, known_sigma_m: float, random: np.random.Generator
) -> list[SeparationScale | None]:
    """What the eyes' separations at every viewpoint tell of the scale, seed for seed."""
    if not known_sigma_m:
        return [None] * seeds
    believed_m = IPD_M + random.normal(scale=known_sigma_m, size=seeds)
    noise = random.normal(scale=EYE_NOISE_M * np.sqrt(2), size=(seeds, len(grid()), 3))
    told = np.linalg.norm(noise + np.array([IPD_M / sensor_scale, 0.0, 0.0]), axis=-1)
    return [
        separation_scale(row, ipd_m=float(ipd_m), ipd_sigma_m=known_sigma_m)
        for row, ipd_m in zip(told, believed_m, strict=True)
    ]


def _all_fits(sensor_m: F64, stack_m: F64, separations: Sequence[SeparationScale | None]) -> dict[str, Similarity]:
    rules: dict[str, ScaleRule] = {
        "seed": "seed",
        "least-squares": "least-squares",
        "inverse": "inverse",
        "fixed-scale": 1.0,
    }
    fits = {name: fit_batch(sensor_m, stack_m, rule=rule) for name, rule in rules.items()}
    robust = [fit_robust(c, w) for c, w in zip(sensor_m, stack_m, strict=True)]
    fits["robust"] = _stacked([r.similarity for r in robust])
    rejects = np.array([not r.inlier.all() for r in robust])
    fits[DEFAULT] = _default(fits, sensor_m, stack_m, rejects, separations)
    return {name: fits[name] for name in (*METHODS, DEFAULT)}


def _stacked(items: Sequence[Similarity]) -> Similarity:
    return Similarity(
        np.array([item.scale for item in items]),
        np.array([item.rotation for item in items]),
        np.array([item.translation_m for item in items]),
    )


def _default(
    fits: dict[str, Similarity],
    sensor_m: F64,
    stack_m: F64,
    rejects: NDArray[np.bool_],
    separations: Sequence[SeparationScale | None],
) -> Similarity:
    """What `solution.solve_default` takes, for a batch."""
    inverse = fits["inverse"]
    _, unit, _ = design_covariance(stack_m[0], fixed_scale=False)
    freedom = 3 * stack_m.shape[-2] - 7
    squares = ((inverse.points(sensor_m) - stack_m) ** 2).sum((-1, -2)) / freedom
    logarithms, spread = np.log(inverse.scale), np.sqrt(unit[6, 6] * squares)
    told = np.array([
        joined(one, sigma, other) for one, sigma, other in zip(logarithms, spread, separations, strict=True)
    ])  # fmt: skip
    believed = posterior_scale(told[:, 0], sigma=told[:, 1], freedom=freedom, prior_sigma=SCALE_SIGMA)
    scale = np.exp(believed.log_scale)
    turned = (inverse.rotation @ sensor_m.mean(axis=-2)[..., None])[..., 0]
    posterior = Similarity(scale, inverse.rotation, stack_m.mean(axis=-2) - scale[..., None] * turned)
    robust = fits["robust"]
    return Similarity(
        np.where(rejects, robust.scale, posterior.scale),
        np.where(rejects[:, None, None], robust.rotation, posterior.rotation),
        np.where(rejects[:, None], robust.translation_m, posterior.translation_m),
    )


@dataclass(frozen=True, slots=True)
class Timing:
    """How long a solver takes, and how well it does, for a number of pairs."""

    method: str
    pairs: int
    ms_p50: float
    error_m: float  # mean at the eye, noise of 3 mm


def time_solvers(counts: Sequence[int], *, repeat: int = 15, sigma_m: float = 0.003) -> list[Timing]:
    """The closed form and the robust method for 3 to many pairs scattered through the viewing volume."""
    random = np.random.default_rng(0)
    volume_m = viewing_volume_m()
    low, high = volume_m.min(axis=0), volume_m.max(axis=0)
    rotation = Rotation.random(rng=random).as_matrix()
    solvers: dict[str, Callable[[F64, F64], Similarity]] = {
        "closed form": lambda c, w: fit(c, w, rule="inverse"),
        "robust": lambda c, w: fit_robust(c, w).similarity,
    }
    found = []
    for count in counts:
        stack_m = random.uniform(low, high, size=(count, 3))
        sensor_m = (stack_m - CAMERA_M) @ rotation + random.normal(scale=sigma_m, size=stack_m.shape)
        for name, solver in solvers.items():
            times, runs = [], 3 if count > 10_000 else repeat
            for _ in range(runs + 1):
                begin = time.perf_counter_ns()
                similarity = solver(sensor_m, stack_m)
                times.append(time.perf_counter_ns() - begin)
            error = np.linalg.norm(similarity.points((volume_m - CAMERA_M) @ rotation) - volume_m, axis=-1)
            found.append(Timing(name, count, float(np.median(times[1:])) / 1e6, float(error.mean())))
    return found
