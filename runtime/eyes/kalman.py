"""A constant-velocity Kalman filter of one point whose axes share noise, and so one covariance.

Bar-Shalom, Li, Kirubarajan (2001), 6.2.2: white-noise acceleration. With equal noise on every axis the gain is the
same for all, and the covariance is three numbers: a step is a few dozen flops, and it can't lose symmetry.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from runtime.records import F64

VARIANCE_FLOOR = 1e-14


class PointState(NamedTuple):
    """Position and velocity of a point, and what is known of them: one axis' 2x2 covariance."""

    position_m: F64  # (n,)
    velocity: F64  # (n,) m/s
    var_position: float  # m²
    covariance: float  # m²/s
    var_velocity: float  # m²/s²


def started(position_m: F64, *, variance: float, speed: float) -> PointState:
    """At a first measurement, at rest, with a velocity that is only known to be about `speed` m/s or less."""
    return PointState(position_m, np.zeros_like(position_m), variance, 0.0, speed**2)


def predicted(state: PointState, dt_s: float, *, acceleration: float) -> PointState:
    """After dt_s >= 0; acceleration: density of its white noise, m²/s³."""
    position, velocity, a, b, c = state
    return PointState(
        position + velocity * dt_s,
        velocity,
        a + dt_s * (2 * b + dt_s * (c + acceleration * dt_s / 3)),
        b + dt_s * (c + acceleration * dt_s / 2),
        c + acceleration * dt_s,
    )


def surprise(state: PointState, measured_m: F64, *, variance: float) -> float:
    """Squared distance of a measurement from the state in units of its variance (chi² of n axes)."""
    error = measured_m - state.position_m
    return float(error @ error) / (state.var_position + variance)


def corrected(state: PointState, measured_m: F64, *, variance: float) -> PointState:
    """With a measurement taken in; variance of one of its axes, m²."""
    position, velocity, a, b, c = state
    total = a + variance
    error = measured_m - position
    # The forms that rounding can't turn negative: a·R/(a+R), and c - b²/(a+R) with a floor.
    kept = variance / total
    var_position = max(a * kept, VARIANCE_FLOOR)
    var_velocity = max(c - b * b / total, VARIANCE_FLOOR)
    limit = math.sqrt(var_position * var_velocity)
    return PointState(
        position + error * (a / total),
        velocity + error * (b / total),
        var_position,
        min(max(b * kept, -limit), limit),
        var_velocity,
    )
