"""Interacting multiple models (Blom and Bar-Shalom 1988): Kalman filters that differ in agility.

Each model follows Singer (1970): acceleration decays with a time constant and is driven by noise. The models differ in
the strength of this noise: a still head needs heavy filtering, a fast head needs light filtering, and a still head can
become a fast one within a tenth of a second. The measurement noise is a covariance matrix, because a camera measures
positions to the right and up twenty times as precisely as depth.

A state has nine numbers: position, velocity and acceleration along x, y and z, in metres and seconds.

Quantities that are measured at the same time are filtered together, with all their models stacked along the first axis.
For arrays this small, numpy's time depends on the number of calls, hardly on the number of models.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime.records import F64

FADE_S = 0.25  # time for an acceleration to decay by a factor of e
LONGEST_S = 1.0  # longest time step
TERMS = 50  # number of terms in the power series; their relative error is 1e-12 after the longest time step
WEIGHT_FLOOR = 1e-6  # minimum probability of each model, so that it can recover
JITTER = 1e-12  # relative increase of all variances if rounding has made a covariance indefinite, by less than 1e-14
BEYOND = 1e30  # larger than any innovation's squared Mahalanobis length
_AXES = np.eye(3)
_EXPONENTS = np.arange(float(TERMS))


class Models(NamedTuple):
    """Motion models of one or more quantities, stacked."""

    quantity: NDArray[np.intp]  # (models,) index of the quantity that a model is for, in ascending order
    first: NDArray[np.intp]  # (quantities,) index of the quantity's first model
    variance: F64  # (models,) variance of the acceleration along each axis, in m²/s⁴
    switched: F64  # (models, models) probability of ending with each model, in the limit of many switches
    unswitched: F64  # (models, models) difference from `switched` in the limit of no switches
    stay_s: float  # mean time that a model applies before the motion switches to another

    @classmethod
    def of(cls, *accelerations: Sequence[float], stay_s: float) -> Models:
        """Stack the models of quantities, each with its models' deviations of acceleration along each axis,
        in m/s². `stay_s` is the mean time that a model applies before the motion switches to another.
        """
        counts = [len(models) for models in accelerations]
        quantity = np.repeat(np.arange(len(counts)), counts)
        same = np.equal.outer(quantity, quantity)
        switched = same / same.sum(axis=0)
        variance = np.square(np.concatenate(accelerations))
        first = np.searchsorted(quantity, np.arange(len(counts)))
        return cls(quantity, first, variance, switched, np.eye(len(quantity)) - switched, stay_s)


class Belief(NamedTuple):
    """Each motion model's state estimate, covariance and probability."""

    state: F64  # (models, 9)
    covariance: F64  # (models, 9, 9)
    weight: F64  # (models,) probabilities; those of a quantity's models add up to 1


class Innovation(NamedTuple):
    """Difference between a measurement and each model's prediction."""

    chi2: F64  # (models,) squared Mahalanobis lengths
    factor: F64  # (models, 13, 13) Cholesky factors, see `innovation`


class Moments(NamedTuple):
    """Moments of the quantities' states, with the models weighted by their probabilities."""

    mean: F64  # (quantities, 3, 3) mean position, velocity and acceleration, by row
    # (10, 9) sums over the quantities, for each pair of axes by column: the covariances of each pair of derivatives,
    # and the variance of the acceleration.
    covariance: F64


def _products(series: F64) -> F64:
    """Return the (n, n, TERMS) products of all pairs of (n, TERMS) power series."""
    return np.array([[np.convolve(one, other)[:TERMS] for other in series] for one in series])


def _series() -> tuple[F64, F64]:
    """Return the (18, TERMS) coefficients of `_motion` for one axis and the (13, TERMS) coefficients of `_outlook`. The
    variable of these power series is the time divided by `FADE_S`. Closed forms would suffer from cancellation.
    """
    power = np.arange(TERMS)
    decay = np.cumprod(np.r_[1.0, -1.0 / power[1:]])  # exp(-x)
    # Position, velocity and acceleration caused by a unit acceleration at time 0.
    response = np.array([FADE_S**2 * decay * (power > 1), -FADE_S * decay * (power > 0), decay])
    step, noise = np.zeros((2, 3, 3, TERMS))
    step[0, 0, 0] = step[1, 1, 0] = 1.0
    step[0, 1, 1] = FADE_S
    step[:, 2] = response
    noise[..., 1:] = 2 * _products(response)[..., :-1] / power[1:]  # integral from 0 to x
    weights = [*step[0], *_products(step[0]).reshape(9, TERMS), noise[0, 0]]
    return np.array([step, noise]).reshape(18, TERMS), np.array(weights)


_MOTION, _POSITION = _series()


def _powers(dt_s: float) -> F64:
    """Return the (TERMS,) powers of a time step in the power series."""
    if not 0 <= dt_s <= LONGEST_S:
        raise ValueError(f"a time step must be from 0 to {LONGEST_S} s, not {dt_s}")
    powers: F64 = (dt_s / FADE_S) ** _EXPONENTS
    return powers


@lru_cache(maxsize=8)  # a simulated sensor's time steps recur
def _motion(dt_s: float) -> F64:
    """Return two (9, 9) matrices for the motion in `dt_s`: to the expected state, and the covariance added. The
    covariance is that of an acceleration noise with a standard deviation of 1 m/s².
    """
    along_one_axis = (_MOTION @ _powers(dt_s)).reshape(2, 3, 1, 3, 1)
    return (along_one_axis * _AXES[:, None, :]).reshape(2, 9, 9)


@lru_cache(maxsize=8)  # one prediction asks several times for the same time step
def _outlook(dt_s: float) -> tuple[F64, F64]:
    """Return the weights of `Moments.mean`'s rows, (3,), and of `Moments.covariance`'s, (10,), for `dt_s` ahead."""
    weights = _POSITION @ _powers(dt_s)
    return weights[:3], weights[3:]


def started(places: F64, *, noise: F64, speeds: Sequence[float], models: Models) -> Belief:
    """Return the belief after first positions (quantities, 3), each with covariance `noise`, and a mean
    velocity of zero. `speeds` are the standard deviations of each quantity's velocity along each axis, in m/s.
    """
    count = len(models.quantity)
    state, covariance = np.zeros((count, 9)), np.zeros((count, 9, 9))
    state[:, :3] = places[models.quantity]
    covariance[:, :3, :3] = noise
    covariance[:, 3:6, 3:6] = np.square(speeds)[models.quantity, None, None] * _AXES
    covariance[:, 6:, 6:] = models.variance[:, None, None] * _AXES
    return Belief(state, covariance, models.switched.diagonal())


def predicted(belief: Belief, dt_s: float, *, models: Models) -> Belief:
    """Return the belief after a step of 0 to `LONGEST_S`: models are first mixed, then propagated."""
    change = models.switched + math.exp(-dt_s / models.stay_s) * models.unswitched
    weight = change @ belief.weight
    shares = change * belief.weight / weight[:, None]  # (into, from)
    mean = shares @ belief.state
    apart = belief.state - mean[:, None]  # (into, from, 9)
    covariance = (shares @ belief.covariance.reshape(-1, 81)).reshape(-1, 9, 9)
    covariance += (apart * shares[:, :, None]).transpose(0, 2, 1) @ apart
    step, noise = _motion(dt_s)
    covariance = step @ covariance @ step.T + models.variance[:, None, None] * noise
    return Belief(mean @ step.T, covariance, weight)


def innovation(belief: Belief, measured: F64, *, noise: F64, models: Models) -> Innovation:
    """Compare measured positions (quantities, 3), each with covariance `noise`, with each model's
    prediction.

    The joint covariance of measurement and state has a Cholesky factor with three parts: the measurement's factor, the
    gain times this factor, and the factor of the corrected state's covariance, which thus stays positive definite. One
    more row of the factor becomes the innovation in units of the measurement's factor.
    """
    joint = np.zeros((len(models.quantity), 13, 13))
    joint[:, :3, :3] = belief.covariance[:, :3, :3] + noise
    joint[:, 3:12, :3] = belief.covariance[:, :, :3]
    joint[:, 3:12, 3:12] = belief.covariance
    joint[:, 12, :3] = measured[models.quantity] - belief.state[:, :3]
    joint[:, 12, 12] = BEYOND
    factor = _cholesky(joint)
    off = factor[:, 12, :3]
    return Innovation(np.vecdot(off, off), factor)


def _cholesky(covariance: F64) -> F64:
    """Return the lower Cholesky factors of (n, k, k) covariances, of which the upper triangles are not used. After a
    long jump, rounding can make a covariance indefinite. All variances are then raised.
    """
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        factor = np.linalg.cholesky(covariance * (1 + JITTER * np.eye(covariance.shape[1])))
    return np.asarray(factor, np.float64)


def surprise(seen: Innovation, *, models: Models) -> float:
    """Return the squared Mahalanobis distance from the most surprising quantity to its nearest model. It
    has a chi² distribution with three degrees of freedom for a good measurement and the right model.
    """
    return float(np.minimum.reduceat(seen.chi2, models.first).max())


def corrected(belief: Belief, seen: Innovation, *, models: Models) -> Belief:
    """Return the belief after a measurement that differs from the prediction by `seen`."""
    gain, rest, off = seen.factor[:, 3:12, :3], seen.factor[:, 3:12, 3:12], seen.factor[:, 12, :3]
    state = belief.state + (gain @ off[:, :, None])[:, :, 0]
    likely = -0.5 * seen.chi2 - np.log(seen.factor.diagonal(axis1=1, axis2=2)[:, :3]).sum(axis=1)
    likely -= np.maximum.reduceat(likely, models.first)[models.quantity]
    weight = belief.weight * np.exp(likely) + WEIGHT_FLOOR
    weight /= np.add.reduceat(weight, models.first)[models.quantity]
    return Belief(state, rest @ rest.transpose(0, 2, 1), weight)


def moments(belief: Belief, *, models: Models) -> Moments:
    """Return the moments of the quantities' states, with the models weighted by their probabilities."""
    share = belief.weight[:, None]
    mean = np.add.reduceat(share * belief.state, models.first)
    apart = belief.state - mean[models.quantity]
    spread = (belief.weight @ belief.covariance.reshape(-1, 81)).reshape(9, 9) + (share * apart).T @ apart
    covariance = np.empty((10, 9))
    covariance[:9] = spread.reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    covariance[9] = (belief.weight @ models.variance) * _AXES.ravel()
    return Moments(mean.reshape(-1, 3, 3), covariance)


def ahead(now: Moments, dt_s: float) -> F64:
    """Return the quantities' expected (quantities, 3) positions after a time step from 0 to LONGEST_S."""
    position: F64 = _outlook(dt_s)[0] @ now.mean
    return position


def spread(now: Moments, dt_s: float) -> F64:
    """Return the sum of the positions' (3, 3) covariances, in m², after a time step from 0 to LONGEST_S."""
    covariance: F64 = (_outlook(dt_s)[1] @ now.covariance).reshape(3, 3)
    return covariance
