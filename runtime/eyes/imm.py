"""Interacting multiple models (Blom and Bar-Shalom 1988): Kalman filters that differ in agility.

Each model follows Singer (1970): acceleration decays with a time constant and is driven by noise. The models differ in
the strength of this noise: a still head needs heavy filtering, a fast head needs light filtering, and a still head can
become a fast one within a tenth of a second. The measurement noise is a covariance matrix, because a camera measures
positions to the right and up twenty times as precisely as depth.

A state has nine numbers: position, velocity and acceleration along x, y and z, in metres and seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from runtime.records import F64

FADE_S = 0.25  # time for an acceleration to decay by a factor of e
ROUNDING = 1e-12  # share of a covariance's trace to add to its diagonal: (10 nm)² for a head's (1 cm)²
WEIGHT_FLOOR = 1e-6  # minimum probability of each model, so that it can recover
_NODES, _SHARES = np.polynomial.legendre.leggauss(10)
_AXES = np.eye(3)


class Belief(NamedTuple):
    """Each motion model's state estimate, covariance and probability."""

    state: F64  # (models, 9)
    covariance: F64  # (models, 9, 9)
    weight: F64  # (models,) probabilities that add up to 1


def _response(times_s: F64) -> F64:
    """Return the (3, n) position, velocity and acceleration caused by a unit acceleration at time 0."""
    x = times_s / FADE_S
    gone = -np.expm1(-x)
    return np.array([FADE_S**2 * (x - gone), FADE_S * gone, 1 - gone])


def _of_each_axis(matrix: F64) -> F64:
    """Return the (9, 9) matrix that applies a (3, 3) matrix to x, y and z separately."""
    return (matrix[:, None, :, None] * _AXES[:, None, :]).reshape(9, 9)


@lru_cache(maxsize=8)
def _transition(dt_s: float) -> F64:
    """Return the (9, 9) matrix that maps a state to the expected state `dt_s` later."""
    step = np.eye(3)
    step[0, 1] = dt_s
    step[:, 2] = _response(np.array([dt_s]))[:, 0]
    return _of_each_axis(step)


@lru_cache(maxsize=8)
def _noise(dt_s: float) -> F64:
    """Return the (9, 9) covariance added to a state in `dt_s` by an acceleration noise of 1 m/s².

    1 m/s² is the noise's standard deviation. The covariance is integrated by Gauss-Legendre quadrature, because the
    closed form suffers from cancellation.
    """
    response = _response(dt_s * (_NODES + 1) / 2)
    return _of_each_axis((response * (_SHARES * dt_s / FADE_S)) @ response.T)


def started(place: F64, *, noise: F64, speed: float, acceleration: Sequence[float]) -> Belief:
    """Return the belief after a first measurement, with a mean velocity of zero.

    Args:
        place: (3,) measured position.
        noise: (3, 3) covariance of the measurement.
        speed: Standard deviation of the velocity along each axis, in m/s.
        acceleration: Standard deviation of each model's acceleration along each axis, in m/s².
    """
    count = len(acceleration)
    state, covariance = np.zeros((count, 9)), np.zeros((count, 9, 9))
    state[:, :3] = place
    covariance[:, :3, :3] = noise
    covariance[:, 3:6, 3:6] = speed**2 * _AXES
    covariance[:, 6:, 6:] = np.square(acceleration)[:, None, None] * _AXES
    return Belief(state, covariance, np.full(count, 1 / count))


def predicted(belief: Belief, dt_s: float, *, acceleration: Sequence[float], stay_s: float) -> Belief:
    """Return the belief after a time step. The models are first mixed, then propagated.

    Args:
        dt_s: Length of the time step, which must not be negative.
        acceleration: Standard deviation of each model's acceleration along each axis, in m/s².
        stay_s: Mean time that a model applies before the motion switches to another.
    """
    count = len(belief.weight)
    leave = -math.expm1(-dt_s / stay_s) / count  # probability of switching to each model, including this one
    change = np.full((count, count), leave) + (1 - count * leave) * np.eye(count)
    shares = belief.weight[:, None] * change
    weight = shares.sum(0)
    shares = shares / weight
    mean = shares.T @ belief.state
    apart = belief.state[:, None] - mean
    covariance = np.tensordot(shares.T, belief.covariance, 1)
    apart = apart.transpose(1, 2, 0)  # (into, 9, from)
    covariance += (apart * shares.T[:, None]) @ apart.transpose(0, 2, 1)
    step = _transition(dt_s)
    added = np.square(acceleration)[:, None, None] * _noise(dt_s)
    return Belief(mean @ step.T, step @ covariance @ step.T + added, weight)


def surprise(belief: Belief, measured: F64, *, noise: F64) -> float:
    """Return the squared Mahalanobis distance from a (3,) measurement to the nearest model.

    For a good measurement and the right model, this has a chi² distribution with three degrees of freedom.

    Args:
        noise: (3, 3) covariance of the measurement.
    """
    return float(_chi2(measured - belief.state[:, :3], _total(belief, noise)).min())


def _total(belief: Belief, noise: F64) -> F64:
    """Return the innovation's (n, 3, 3) covariances, regularized against rounding after a long jump."""
    total = belief.covariance[:, :3, :3] + noise
    spread: F64 = np.trace(total, axis1=1, axis2=2)[:, None, None] * ROUNDING
    return np.asarray(total + spread * np.eye(3), np.float64)


def _chi2(off: F64, covariance: F64) -> F64:
    """Return the (n,) squared Mahalanobis lengths of (n, 3) vectors with (n, 3, 3) covariances."""
    result: F64 = (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(1)
    return result


def corrected(belief: Belief, measured: F64, *, noise: F64) -> Belief:
    """Return the belief after a measurement.

    Args:
        measured: (3,) measured position.
        noise: (3, 3) covariance of the measurement.
    """
    total = _total(belief, noise)
    gain = np.linalg.solve(total, belief.covariance[:, :3, :]).transpose(0, 2, 1)
    off = measured - belief.state[:, :3]
    likely = -0.5 * (_chi2(off, total) + np.linalg.slogdet(total)[1])
    weight = belief.weight * np.exp(likely - likely.max()) + WEIGHT_FLOOR
    # Joseph's form keeps variances positive despite rounding.
    keep = np.repeat(np.eye(9)[None], len(weight), axis=0)
    keep[:, :, :3] -= gain
    covariance = keep @ belief.covariance @ keep.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    state = belief.state + (gain @ off[..., None])[..., 0]
    return Belief(state, _positive((covariance + covariance.transpose(0, 2, 1)) / 2), weight / weight.sum())


def _positive(covariance: F64) -> F64:
    """Return (n, 9, 9) covariances with all eigenvalues made positive.

    After a long jump, rounding can make an eigenvalue negative.
    """
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        size = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 1e-12))
        scale = size[:, :, None] * size[:, None, :]
        shares, axes = np.linalg.eigh(covariance / scale)
        covariance = scale * ((axes * np.maximum(shares, 1e-9)[:, None]) @ axes.transpose(0, 2, 1))
    return covariance


def ahead(belief: Belief, dt_s: float) -> F64:
    """Return the expected (3,) position `dt_s` later, weighting the models by their probabilities."""
    position: F64 = _transition(dt_s)[:3] @ (belief.weight @ belief.state)
    return position


def spread(belief: Belief, dt_s: float, *, acceleration: Sequence[float], about: F64) -> F64:
    """Return the (3, 3) second moment, about a given point, of the position after a time step, in m².

    Args:
        dt_s: Length of the time step.
        acceleration: Standard deviation of each model's acceleration along each axis, in m/s².
        about: (3,) point.
    """
    step = _transition(dt_s)[:3]
    added = np.square(acceleration)[:, None, None] * _noise(dt_s)[:3, :3]
    apart = belief.state @ step.T - about
    each = step @ belief.covariance @ step.T + added + apart[:, :, None] * apart[:, None, :]
    result: F64 = np.tensordot(belief.weight, each, 1)
    return result
