"""Interacting multiple models (Blom and Bar-Shalom 1988): constant-velocity Kalman filters that share one point.

A still head wants a heavy filter, a hasty one a light filter, and which it is changes in a tenth of a second. Each
model is the filter with white-noise acceleration of Bar-Shalom, Li, Kirubarajan (2001), 6.2.2. With equal noise on all
axes its gain is the same for all and its covariance that of one axis, three numbers that can't lose symmetry; where
means are mixed their spread is shared equally among the axes. With one model it is the plain Kalman filter.
Plain floats: for three models of three axes they take a quarter of the time of small arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

VARIANCE_FLOOR = 1e-14
WEIGHT_FLOOR = 1e-6

Vector = tuple[float, float, float]


class Model(NamedTuple):
    """One filter: position (m), velocity (m/s), one axis' covariance, and how much it is believed."""

    x: float
    y: float
    z: float
    u: float  # velocity along x
    v: float
    w: float
    var_position: float
    covariance: float
    var_velocity: float
    weight: float


def started(place: Sequence[float], *, count: int, variance: float, speed: float) -> tuple[Model, ...]:
    """At a first measurement, at rest, with a velocity that is only known to be about `speed` m/s or less."""
    x, y, z = place
    return (Model(x, y, z, 0.0, 0.0, 0.0, variance, 0.0, speed * speed, 1 / count),) * count


def predicted(
    models: tuple[Model, ...], dt_s: float, *, acceleration: Sequence[float], stay_s: float
) -> tuple[Model, ...]:
    """After dt_s >= 0: the models mix, then each moves on.

    acceleration: each model's density of white acceleration noise, m²/s³; stay_s: mean time in one model.
    """
    stay = math.exp(-dt_s / stay_s)
    leave = (1 - stay) / (len(models) - 1) if len(models) > 1 else 0.0
    stay = 1 - leave * (len(models) - 1)
    result = []
    for into, q in enumerate(acceleration):
        shares = [m.weight * (stay if i == into else leave) for i, m in enumerate(models)]
        weight = sum(shares)
        x = y = z = u = v = w = a = b = c = 0.0
        for share, m in zip(shares, models):
            share /= weight
            x, y, z = x + share * m.x, y + share * m.y, z + share * m.z
            u, v, w = u + share * m.u, v + share * m.v, w + share * m.w
            a, b, c = a + share * m.var_position, b + share * m.covariance, c + share * m.var_velocity
        for share, m in zip(shares, models):
            share /= 3 * weight
            dx, dy, dz, du, dv, dw = m.x - x, m.y - y, m.z - z, m.u - u, m.v - v, m.w - w
            a += share * (dx * dx + dy * dy + dz * dz)
            b += share * (dx * du + dy * dv + dz * dw)
            c += share * (du * du + dv * dv + dw * dw)
        noise = q * dt_s
        result.append(
            Model(
                x + u * dt_s,
                y + v * dt_s,
                z + w * dt_s,
                u,
                v,
                w,
                a + dt_s * (2 * b + dt_s * (c + noise / 3)),
                b + dt_s * (c + noise / 2),
                c + noise,
                weight,
            )
        )
    return tuple(result)


def surprise(models: tuple[Model, ...], measured: Sequence[float], *, variance: float) -> float:
    """Least squared distance of a measurement from any model, in units of its variance (chi² of three axes)."""
    x, y, z = measured
    return min(((x - m.x) ** 2 + (y - m.y) ** 2 + (z - m.z) ** 2) / (m.var_position + variance) for m in models)


def corrected(models: tuple[Model, ...], measured: Sequence[float], *, variance: float) -> tuple[Model, ...]:
    """With a measurement taken in; variance of one of its axes, m²."""
    x, y, z = measured
    logs = []
    for m in models:
        total = m.var_position + variance
        logs.append(-0.5 * (((x - m.x) ** 2 + (y - m.y) ** 2 + (z - m.z) ** 2) / total + 3 * math.log(total)))
    best = max(logs)
    weights = [m.weight * math.exp(value - best) + WEIGHT_FLOOR for m, value in zip(models, logs)]
    whole = sum(weights)
    result = []
    for (px, py, pz, u, v, w, a, b, c, _), weight in zip(models, weights):
        total = a + variance
        dx, dy, dz = x - px, y - py, z - pz
        k, kv, kept = a / total, b / total, variance / total
        # The forms that rounding can't turn negative: a·R/(a+R), and c - b²/(a+R) with a floor.
        a = max(a * kept, VARIANCE_FLOOR)
        c = max(c - b * kv, VARIANCE_FLOOR)
        limit = math.sqrt(a * c)
        b = min(max(b * kept, -limit), limit)
        place = px + k * dx, py + k * dy, pz + k * dz
        result.append(Model(*place, u + kv * dx, v + kv * dy, w + kv * dz, a, b, c, weight / whole))
    return tuple(result)


def combined(models: tuple[Model, ...]) -> tuple[Vector, Vector]:
    """Position and velocity: the models' mean by belief."""
    x = y = z = u = v = w = 0.0
    for m in models:
        share = m.weight
        x, y, z = x + share * m.x, y + share * m.y, z + share * m.z
        u, v, w = u + share * m.u, v + share * m.v, w + share * m.w
    return (x, y, z), (u, v, w)


def deviation(models: tuple[Model, ...], ahead_s: float, *, acceleration: Sequence[float]) -> float:
    """Standard deviation of an axis of the models' common position, metres, so many seconds ahead.

    The mixture's: each model's own variance carried on, and the spread of what they predict (shared among the axes).
    """
    x = y = z = 0.0
    ahead = []
    for m in models:
        place = m.x + m.u * ahead_s, m.y + m.v * ahead_s, m.z + m.w * ahead_s
        ahead.append(place)
        x, y, z = x + m.weight * place[0], y + m.weight * place[1], z + m.weight * place[2]
    variance = VARIANCE_FLOOR
    for m, q, (px, py, pz) in zip(models, acceleration, ahead):
        own = m.var_position + ahead_s * (2 * m.covariance + ahead_s * (m.var_velocity + q * ahead_s / 3))
        variance += m.weight * (own + ((px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2) / 3)
    return math.sqrt(variance)
