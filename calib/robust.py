"""Fit a similarity to pairs of points, some of which may have gross errors.

FAST-LTS (Rousseeuw & Van Driessen 1999) finds the half of the pairs that agree best. The noise is estimated from this
half, and pairs with much larger errors are rejected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calib.similarity import Degenerate, ScaleRule, Similarity, fit, fit_batch
from runtime.records import F64

STARTS = 120  # number of random subsets to start from
START_PAIRS = 4  # number of pairs in each subset
STEPS = 4  # number of concentration steps from each subset
MAX_SCORED = 2000  # number of pairs above which the search uses a random sample; all pairs are then tested
REJECTION_PROBABILITY = 1e-4  # probability that a good pair with Gaussian noise is rejected
RULE: ScaleRule = "inverse"
MIN_NOISE = 1e-12  # minimum noise relative to the points' extent, so that exact data are not rejected


@dataclass(frozen=True, slots=True)
class RobustFit:
    """A similarity fitted to the pairs that agree with each other."""

    similarity: Similarity
    inlier: NDArray[np.bool_]  # (K,) True for pairs that agree, False for rejected pairs


def _residuals(candidate: Similarity, sensor_m: F64, stack_m: F64) -> F64:
    """Return squared errors (..., K) in m² over the squared scale, which would otherwise favour small scales."""
    squared = ((candidate.points(sensor_m) - stack_m) ** 2).sum(-1)
    residuals: F64 = squared / np.maximum(candidate.scale[..., None], 1e-300) ** 2
    return residuals


def _best_half(sensor_m: F64, stack_m: F64, *, random: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of the half of the pairs that agree best. The search starts from many random subsets. Each fit
    is then repeated on the half of the pairs that it fits best.
    """
    count = len(sensor_m)
    keep = min(count, max(3, (count + 5) // 2))
    chosen = np.argsort(random.random((STARTS, count)), axis=1)[:, : min(START_PAIRS, count)]
    for _ in range(1 + STEPS):
        candidates = fit_batch(sensor_m[chosen], stack_m[chosen], rule=RULE)
        squared = np.nan_to_num(_residuals(candidates, sensor_m, stack_m), nan=np.inf)
        chosen = np.argpartition(squared, keep - 1, axis=-1)[:, :keep]
    sums = np.take_along_axis(squared, chosen, axis=-1).sum(-1)
    winner = int(np.argmin(sums))
    if not np.isfinite(sums[winner]):
        raise Degenerate("no similarity transform fits at least half of the pairs; check the pairs or capture new ones")
    return np.asarray(chosen[winner])


def fit_robust(sensor_m: F64, stack_m: F64) -> RobustFit:
    """Fit a similarity, deterministically, to those of K >= 3 points (K, 3) in `sensor` and `stack` that
    agree. Five pairs or fewer have no clear majority, so all of them are used. Raises Degenerate as
    `similarity.fit`.
    """
    count = len(sensor_m)
    everything = fit(sensor_m, stack_m, rule=RULE)
    spread = float(np.sqrt(((stack_m - stack_m.mean(0)) ** 2).sum(-1).mean()))
    if count <= 5:
        return RobustFit(everything, np.ones(count, bool))
    random = np.random.default_rng(0)
    scored = random.permutation(count)[:MAX_SCORED] if count > MAX_SCORED else np.arange(count)
    # The points are centred for precision, because the batched fits are not refined.
    half = scored[_best_half(sensor_m[scored] - sensor_m.mean(0), stack_m[scored] - stack_m.mean(0), random=random)]
    limit = float(chi2.ppf(1 - REJECTION_PROBABILITY, 3))
    inlier = np.zeros(count, bool)
    inlier[half] = True
    current = fit(sensor_m[inlier], stack_m[inlier], rule=RULE)
    squared = ((current.points(sensor_m) - stack_m) ** 2).sum(-1)
    # Estimate the noise from a quantile of chi² with three degrees of freedom, and correct the bias of small samples.
    share = len(half) / len(scored)
    noise_m = np.sqrt(np.partition(squared[scored], len(half) - 1)[len(half) - 1] / chi2.ppf(0.999 * share, 3))
    noise_m *= 1 + 5 / max(len(scored) - 3, 1)
    for _ in range(20):
        kept = squared <= limit * max(noise_m, MIN_NOISE * spread) ** 2
        if kept.sum() < 3:
            break
        current = fit(sensor_m[kept], stack_m[kept], rule=RULE)
        squared = ((current.points(sensor_m) - stack_m) ** 2).sum(-1)
        noise_m = max(_noise(current, sensor_m, stack_m, kept), noise_m * 0.5)
        if np.array_equal(kept, inlier):
            break
        inlier = kept
    return RobustFit(everything if inlier.all() else current, inlier)


def _noise(similarity: Similarity, sensor_m: F64, stack_m: F64, inlier: NDArray[np.bool_]) -> float:
    """Return the inliers' deviation per coordinate in `stack`, with seven degrees of freedom less for the fit."""
    squared = ((similarity.points(sensor_m) - stack_m) ** 2).sum(-1)[inlier].sum()
    return float(np.sqrt(squared / max(3 * int(inlier.sum()) - 7, 1)))
