"""The similarity from the sensor's frame to the stack's (EyeReal supplement, (15)-(28)).

From pairs that hardly determine it, and from noisy ones by every rule, against closed forms of 50 digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from runtime.records import F64
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS64, Answer, Trial

STAGE = "calibration"
Fit = Callable[[F64, F64], F64]  # (K, 3) sensor, (K, 3) stack, metres -> 4x4 stack_from_sensor
LEAST_SQUARES = "least-squares"
QUATERNION = (2, -1, 3, 5)  # whole numbers: the rotation is exact
HALF_TURN = (0, 1, 2, 2)


def rotation(quaternion: tuple[int, int, int, int]) -> list[list[Any]]:
    """The rotation of a whole-numbered quaternion (w, x, y, z), exactly."""
    w, x, y, z = (exact.mpf(c) for c in quaternion)
    n = w * w + x * x + y * y + z * z
    return [
        [(w * w + x * x - y * y - z * z) / n, 2 * (x * y - w * z) / n, 2 * (x * z + w * y) / n],
        [2 * (x * y + w * z) / n, (w * w - x * x + y * y - z * z) / n, 2 * (y * z - w * x) / n],
        [2 * (x * z - w * y) / n, 2 * (y * z + w * x) / n, (w * w - x * x - y * y + z * z) / n],
    ]


def cloud(*, aspect: float = 1.0, size_m: float = 0.3, count: int = 27) -> F64:
    """(n, 3) points spread over `size_m` along one axis and over `aspect` of it along the others."""
    return np.random.default_rng(11).uniform(-1, 1, (count, 3)) * [size_m, size_m * aspect, size_m * aspect]


def placed(rows: Sequence[Sequence[Any]], point: F64) -> list[Any]:
    """(3,) where a transform (3 or 4, 4) puts a point, exactly."""
    x, y, z = exact.vector(point)
    return [row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows[:3]]


def exactly(matrix: F64) -> list[list[Any]]:
    """A matrix of exact numbers."""
    return [[exact.mpf(float(value)) for value in row] for row in matrix]


def exact_similarity(sensor_m: F64, stack_m: F64, rule: str) -> list[list[Any]]:
    """(3, 4) [sR t] of pairs by 50 digits: the rotation of the centred points' singular vectors, the rule's scale."""
    mp, count = exact.mp, len(sensor_m)
    points = [[[exact.mpf(float(x)) for x in row] for row in side] for side in (sensor_m, stack_m)]
    means = [[sum(row[j] for row in side) / count for j in range(3)] for side in points]
    sensor, stack = (
        [[row[j] - mean[j] for j in range(3)] for row in side] for side, mean in zip(points, means, strict=True)
    )
    cross = mp.matrix(3, 3)
    for i in range(3):
        for j in range(3):
            cross[i, j] = sum(c[i] * w[j] for c, w in zip(sensor, stack, strict=True))
    left, values, right = mp.svd_r(cross)
    sign = mp.sign(mp.det(left) * mp.det(right))
    rotation = right.T * mp.diag([1, 1, sign]) * left.T
    power = [sum(x * x for row in side for x in row) for side in (sensor, stack)]
    correlation = values[0] + values[1] + sign * values[2]
    scale = {
        "seed": mp.sqrt(power[1] / power[0]),
        LEAST_SQUARES: correlation / power[0],
        "inverse": power[1] / correlation,
        "fixed-scale": exact.mpf(1),
    }[rule]
    return [
        [scale * rotation[i, j] for j in range(3)]
        + [means[1][i] - scale * sum(rotation[i, j] * means[0][j] for j in range(3))]
        for i in range(3)
    ]


def fitted(
    fit: Fit,
    rule: str,
    true_m: F64,
    *,
    noise_m: float = 0.0,
    scale: float = 1.0,
    offset_m: tuple[float, float, float] = (0.1, -0.4, 0.3),
    quaternion: tuple[int, int, int, int] = QUATERNION,
    wrong: int = 0,
) -> Answer:
    """Points turned, scaled and shifted, with noise on the sensor's side: the rule's own optimum, in closed form.

    wrong: so many pairs are decimetres off, and `rule` is what the others must be fitted by. The condition is how far
    the points reach from the origin over the second largest of their extents: that much a relative error of the
    coordinates, rounding included, can turn the fit. Without noise its turn and scale are compared as well.
    """
    random = np.random.default_rng(1)
    turn = np.array([[float(x) for x in row] for row in rotation(quaternion)])
    stack_m = scale * true_m @ turn.T + offset_m
    sensor_m = true_m + random.normal(0, noise_m, true_m.shape)
    good = np.arange(len(true_m)) >= wrong
    sensor_m[~good] += random.choice([-1.0, 1.0], (wrong, 3)) * random.uniform(0.1, 0.5, (wrong, 3))
    found = fit(sensor_m, stack_m)
    if found.shape != (4, 4) or not np.array_equal(found[3], [0, 0, 0, 1]):
        return Answer(math.nan, 0.0, note="no transform")
    truth = exact_similarity(sensor_m[good], stack_m[good], rule)
    places = [(placed(exactly(found), p), placed(truth, p)) for p in sensor_m[good]]
    error = max(float(abs(ours - theirs)) for pair in places for ours, theirs in zip(*pair, strict=True))
    error /= float(np.abs(stack_m).max())
    if not noise_m:
        size = exact.mp.sqrt(sum(x * x for x in truth[0][:3]))
        turned = max(exact.distance(found[i, j] / scale, truth[i][j] / size) for i in range(3) for j in range(3))
        error = max(error, turned)
    condition = max(
        float(np.abs(p).max() / np.linalg.svd(p[good] - p[good].mean(0), compute_uv=False)[1] * len(p) ** 0.5)
        for p in (sensor_m, stack_m)
    )
    return Answer(error, (64 if noise_m else 16) * EPS64 * condition, condition, error / condition)


def trials(fits: Mapping[str, Fit]) -> Iterator[Trial]:
    """Every case of the calibration; `fits`: the solvers under trial by their rule: seed, least-squares, inverse,
    fixed-scale (at 1) and robust."""
    for rule, solver in fits.items():
        run = partial(fitted, solver, "inverse" if rule == "robust" else rule)
        for millimetres in (0.1, 3, 30):
            noisy = partial(run, cloud(), noise_m=millimetres / 1000)
            yield Trial(STAGE, f"{rule}: {millimetres:g} mm of noise", noisy, measure="of the size")
        thin = partial(run, cloud(aspect=0.01), noise_m=1e-5)
        yield Trial(STAGE, f"{rule}: noise on thin points", thin, measure="of the size")
        if rule != "fixed-scale":
            mixed = partial(run, cloud(), noise_m=0.003, scale=1000.0)
            yield Trial(STAGE, f"{rule}: noise, units mixed", mixed, measure="of the size")
    if "robust" in fits:
        for count in (1, 5):
            run = partial(fitted, fits["robust"], "inverse", cloud(), noise_m=0.003, wrong=count)
            yield Trial(STAGE, f"robust: {count} of 27 pairs decimetres off", run, measure="of the size")
    fit = partial(fitted, fits[LEAST_SQUARES], LEAST_SQUARES)
    cases: dict[str, Callable[[], Answer]] = {
        **{f"points 1e-{power} as wide as long": partial(fit, cloud(aspect=10.0**-power)) for power in (0, 1, 3, 5, 7)},
        **{f"points {metres:g} m from the origin": partial(fit, cloud() + metres) for metres in (1e2, 1e4, 1e6)},
        **{
            f"points within {size:g} m": partial(fit, cloud(size_m=size), offset_m=(size, -size, 2 * size))
            for size in (1e-9, 1e-3, 1e3, 1e150)
        },
        **{f"scale {scale:g} (units mixed)": partial(fit, cloud(), scale=scale) for scale in (1e-3, 1e3)},
        "half a turn": partial(fit, cloud(), quaternion=HALF_TURN),
        "no turn": partial(fit, cloud(), quaternion=(1, 0, 0, 0)),
        "three pairs": partial(fit, cloud(count=3)),
        "all points in one plane": partial(fit, cloud() * [1, 1, 0]),
    }
    for name, case in cases.items():
        yield Trial(STAGE, name, case, measure="rad")
