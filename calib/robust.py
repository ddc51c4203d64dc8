"""Robust similarities from pairs with gross errors: least trimmed squares, rejection, refit.

Least trimmed squares (Rousseeuw 1984) with concentration steps (FAST-LTS, Rousseeuw & Van Driessen 1999) finds the
half of the pairs that agree best. Pairs beyond the noise estimated from this half are rejected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calib.similarity import Degenerate, ScaleRule, Similarity, fit, fit_batch
from runtime.records import F64

STARTS = 120  # random subsets to start from
START_PAIRS = 4  # pairs in each subset
STEPS = 4  # concentration steps from each subset
MAX_SCORED = 2000  # with more pairs, the starts use a random sample; rejection uses all pairs
REJECTION_PROBABILITY = 1e-4  # probability that a good pair with Gaussian noise is rejected
RULE: ScaleRule = "inverse"
MIN_NOISE = 1e-12  # relative to the points' extent; prevents rejection of exact data because of rounding


@dataclass(frozen=True, slots=True)
class RobustFit:
    """A similarity fitted to the pairs that agree."""

    similarity: Similarity
    inlier: NDArray[np.bool_]  # (K,) True for pairs that agree


def _residuals(candidate: Similarity, sensor_m: F64, stack_m: F64) -> F64:
    """(..., K) squared distances, m², divided by the squared scale, so that a small scale gives no advantage."""
    squared = ((candidate.points(sensor_m) - stack_m) ** 2).sum(-1)
    residuals: F64 = squared / np.maximum(candidate.scale[..., None], 1e-300) ** 2
    return residuals


def _best_half(sensor_m: F64, stack_m: F64, *, random: np.random.Generator) -> NDArray[np.intp]:
    """Find the half of the pairs that agree best, from many starts, each refitted to its best half."""
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
        raise Degenerate("no half of the pairs agrees on one similarity transform; check the pairs or capture new ones")
    return np.asarray(chosen[winner])


def fit_robust(sensor_m: F64, stack_m: F64) -> RobustFit:
    """Fit a similarity to the pairs that agree, (K, 3) each, K >= 3. The result is deterministic.

    With five pairs or fewer there is no clear majority, so all are kept. Raises Degenerate as `fit` does.
    """
    count = len(sensor_m)
    everything = fit(sensor_m, stack_m, rule=RULE)
    spread = float(np.sqrt(((stack_m - stack_m.mean(0)) ** 2).sum(-1).mean()))
    if count <= 5:
        return RobustFit(everything, np.ones(count, bool))
    random = np.random.default_rng(0)
    scored = random.permutation(count)[:MAX_SCORED] if count > MAX_SCORED else np.arange(count)
    # Centred, because the batched fits are not refined.
    half = scored[_best_half(sensor_m[scored] - sensor_m.mean(0), stack_m[scored] - stack_m.mean(0), random=random)]
    limit = float(chi2.ppf(1 - REJECTION_PROBABILITY, 3))
    inlier = np.zeros(count, bool)
    inlier[half] = True
    current = fit(sensor_m[inlier], stack_m[inlier], rule=RULE)
    squared = ((current.points(sensor_m) - stack_m) ** 2).sum(-1)
    # Noise from a quantile of chi² with three degrees of freedom, corrected for its bias in small samples.
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
    """Standard deviation of one coordinate in `stack`; the fit uses up seven degrees of freedom."""
    squared = ((similarity.points(sensor_m) - stack_m) ** 2).sum(-1)[inlier].sum()
    return float(np.sqrt(squared / max(3 * int(inlier.sum()) - 7, 1)))
