"""Fit a similarity to pairs of points in closed form (EyeReal supplement, (19)-(27)).

A similarity maps a point c in the `sensor` frame to the point w = s·R·c + t in the `stack` frame. The rotation
maximises the correlation of the centred points (Kabsch, Umeyama 1991). The scale is known, or depends on a rule
(docs/calibration.md): `least-squares` minimises the error in the stack frame (EyeReal, (20)), so that sensor noise
makes it too small; `inverse` minimises it in the sensor frame, which is consistent if only the sensor's points are
noisy; `seed`, the ratio of the RMS radii (22), is the geometric mean of both.

If some pairs may have gross errors, FAST-LTS (Rousseeuw & Van Driessen 1999) finds the half of the pairs that agree
best. The noise is estimated from this half, and pairs with much larger errors are rejected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from runtime.records import F64

ScaleRule = Literal["seed", "least-squares", "inverse"] | float
EPSILON = float(np.finfo(np.float64).eps)
ROTATION_BOUND_RAD = 1e-6  # rotation caused by rounding errors above which points are refused
STARTS = 120  # number of random subsets to start from
START_PAIRS = 4  # number of pairs in each subset
STEPS = 4  # number of concentration steps from each subset
MAX_SCORED = 2000  # number of pairs above which the search uses a random sample; all pairs are then tested
REJECTION_PROBABILITY = 1e-4  # probability that a good pair with Gaussian noise is rejected
RULE: ScaleRule = "inverse"
MIN_NOISE = 1e-12  # minimum noise relative to the points' extent, so that exact data are not rejected


class Degenerate(ValueError):
    """Raised, with the reason, if the points do not determine a similarity in double precision."""


@dataclass(frozen=True, slots=True)
class Similarity:
    """Similarity from the `sensor` frame to the `stack` frame, or a batch of similarities."""

    scale: F64  # (...), the dimensions of the batch
    rotation: F64  # (..., 3, 3)
    translation_m: F64  # (..., 3), frame `stack`

    @property
    def matrix(self) -> F64:
        """Homogeneous matrix (..., 4, 4) of the form [sR t; 0 1]."""
        matrix = np.zeros((*self.scale.shape, 4, 4))
        matrix[..., :3, :3] = self.scale[..., None, None] * self.rotation
        matrix[..., :3, 3] = self.translation_m
        matrix[..., 3, 3] = 1.0
        return matrix

    def points(self, sensor_m: ArrayLike) -> F64:
        """Transform points (..., K, 3) from the `sensor` frame to the `stack` frame."""
        linear = self.scale[..., None, None] * self.rotation
        return np.asarray(sensor_m) @ np.swapaxes(linear, -1, -2) + self.translation_m[..., None, :]


def _centred(points: F64) -> tuple[F64, F64]:
    """Return the centred points and their mean, in two passes for the precision of points far from the origin."""
    mean = np.zeros((*points.shape[:-2], 1, 3))
    for _ in range(2):
        mean = mean + (points - mean).mean(axis=-2, keepdims=True)
    return points - mean, mean[..., 0, :]


def _scale(rule: ScaleRule, *, sensor_power: F64, stack_power: F64, correlation: F64) -> F64:
    if rule == "seed":
        return np.sqrt(stack_power / sensor_power)
    if rule == "least-squares":
        return correlation / sensor_power
    if rule == "inverse":
        return stack_power / correlation
    return np.full(np.shape(correlation), float(rule))


def fit_batch(sensor_m: F64, stack_m: F64, *, rule: ScaleRule) -> Similarity:
    """Fit a similarity to each batch of pairs (..., K, 3) unchecked: degenerate points give NaN."""
    sensor, sensor_mean = _centred(sensor_m)
    stack, stack_mean = _centred(stack_m)
    left, values, right = np.linalg.svd(np.swapaxes(sensor, -1, -2) @ stack)
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    right = np.concatenate([right[..., :2, :], right[..., 2:, :] * sign[..., None, None]], axis=-2)
    rotation = np.swapaxes(left @ right, -1, -2)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = _scale(
            rule,
            sensor_power=(sensor**2).sum((-1, -2)),
            stack_power=(stack**2).sum((-1, -2)),
            correlation=values[..., 0] + values[..., 1] + sign * values[..., 2],
        )
        turned = (rotation @ sensor_mean[..., None])[..., 0]
        return Similarity(scale, rotation, stack_mean - scale[..., None] * turned)


def extents(points_m: F64) -> F64:
    """Return the RMS extents (3,) of points (K, 3) along their principal axes, in metres, largest first."""
    centred, _ = _centred(points_m)
    size = float(np.abs(centred).max(initial=0.0))
    if size == 0.0:
        return np.zeros(3)
    values = np.linalg.svd(centred / size, compute_uv=False) * size / np.sqrt(len(points_m))
    return np.concatenate([values, np.zeros(3 - len(values))])


def fit(sensor_m: F64, stack_m: F64, *, rule: ScaleRule) -> Similarity:
    """Fit a similarity to K >= 3 points (K, 3) in `sensor` and `stack` in full double precision.

    `rule` is a rule for the scale, or the known scale. Raises Degenerate if the points are too few, not finite,
    coincident, collinear or uncorrelated, or so nearly collinear or so far from the origin that rounding errors alone
    could rotate the result by more than `ROTATION_BOUND_RAD`. Measurement noise is not considered.
    """
    if len(sensor_m) < 3:
        raise Degenerate(f"there are only {len(sensor_m)} pairs, but at least 3 are needed")
    if not (np.isfinite(sensor_m).all() and np.isfinite(stack_m).all()):
        raise Degenerate("some coordinates are not finite")
    _refuse_degenerate("sensor", sensor_m)
    _refuse_degenerate("stack", stack_m)
    # Scale by powers of two, which is exact. Without scaling, the squares of 1e-200 m or 1e200 m would fall outside
    # float64's range.
    sensor_unit, stack_unit = (float(np.exp2(np.frexp(np.abs(p).max())[1])) for p in (sensor_m, stack_m))
    unit_rule = rule if isinstance(rule, str) else rule * sensor_unit / stack_unit
    unit_sensor, unit_stack = sensor_m / sensor_unit, stack_m / stack_unit
    unit = fit_batch(unit_sensor, unit_stack, rule=unit_rule)
    if not (np.isfinite(unit.scale) and unit.scale > 0):
        raise Degenerate(
            "the sensor points and the stack points are not correlated; check that the points of each pair belong "
            "together"
        )
    unit = _turned_about_long_axis(unit, unit_sensor, unit_stack)
    return Similarity(unit.scale * (stack_unit / sensor_unit), unit.rotation, unit.translation_m * stack_unit)


def _refuse_degenerate(name: str, points_m: F64) -> None:
    first, second, _ = extents(points_m)
    magnitude = float(np.abs(points_m).max(initial=0.0))
    if first <= 4 * EPSILON * magnitude:
        raise Degenerate(f"the {name} points coincide; use viewpoints that are farther apart")
    if second <= 4 * EPSILON * magnitude:
        raise Degenerate(f"the {name} points all lie on one line, so the rotation about that line is unknown")
    bound = 4 * EPSILON * magnitude / second  # verified with 50-digit arithmetic: `phasestack stability`
    if bound > ROTATION_BOUND_RAD:
        raise Degenerate(
            f"the {name} points are too close to one line or too far from the origin for double precision: "
            f"rounding alone rotates the result by up to {bound:.1g} rad"
        )


def _turned_about_long_axis(start: Similarity, sensor_m: F64, stack_m: F64) -> Similarity:
    """Compute the rotation about the stack points' long axis again, from the coordinates across this axis alone.

    The cross-covariance squares the aspect ratio of a long, thin cloud, and so loses the digits of this rotation. Its
    closed form in the points' principal frame has an error that grows with the aspect ratio rather than its square.
    """
    sensor, sensor_mean = _centred(sensor_m)
    stack, stack_mean = _centred(stack_m)
    _, _, axes = np.linalg.svd(stack, full_matrices=False)
    target = stack @ axes.T
    rotation = axes @ start.rotation  # from the sensor to the principal frame of the stack's points
    y, z = (sensor @ rotation.T)[:, 1:].T
    angle = np.arctan2((y * target[:, 2] - z * target[:, 1]).sum(), (y * target[:, 1] + z * target[:, 2]).sum())
    rotation = Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix() @ rotation
    # Each product of rotations loses an ulp of orthogonality, which one Newton-Schulz step restores.
    rotation = rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation)
    rotation = axes.T @ rotation
    return Similarity(start.scale, rotation, stack_mean - start.scale * (rotation @ sensor_mean))


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
        with np.errstate(invalid="ignore"):  # pairs from a sensor that stood still have an infinite scale
            squared = np.nan_to_num(_residuals(candidates, sensor_m, stack_m), nan=np.inf)
        chosen = np.argpartition(squared, keep - 1, axis=-1)[:, :keep]
    sums = np.take_along_axis(squared, chosen, axis=-1).sum(-1)
    winner = int(np.argmin(sums))
    if not np.isfinite(sums[winner]):
        raise Degenerate("no similarity transform fits at least half of the pairs; check the pairs or capture new ones")
    return np.asarray(chosen[winner])


def fit_robust(sensor_m: F64, stack_m: F64) -> RobustFit:
    """Fit a similarity, deterministically, to those of K >= 3 points (K, 3) in `sensor` and `stack` that
    agree. Five pairs or fewer are all used, because half of them means every one. Raises Degenerate as `fit`.
    """
    count = len(sensor_m)
    everything = fit(sensor_m, stack_m, rule=RULE)
    spread = float(np.sqrt(((stack_m - stack_m.mean(0)) ** 2).sum(-1).mean()))
    random = np.random.default_rng(0)
    scored = random.permutation(count)[:MAX_SCORED] if count > MAX_SCORED else np.arange(count)
    # The points are centred for precision, because the batched fits are only as precise as the cross-covariance.
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
