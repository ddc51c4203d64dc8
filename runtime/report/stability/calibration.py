"""The similarity from the sensor's frame to the stack's, from pairs that hardly determine it (seed 15-28)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from runtime.records import F64
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS64, Answer, Trial, refusal

STAGE = "calibration"
Fit = Callable[[F64, F64], F64]  # (K, 3) sensor, (K, 3) stack, metres -> 4x4 stack_from_sensor
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
    """Points spread over `size_m` along one axis and over `aspect` of it along the others."""
    return np.random.default_rng(11).uniform(-1, 1, (count, 3)) * [size_m, size_m * aspect, size_m * aspect]


def recovered(
    fit: Fit,
    sensor_m: F64,
    *,
    scale: float = 1.0,
    offset_m: tuple[float, float, float] = (0.1, -0.4, 0.3),
    quaternion: tuple[int, int, int, int] = QUATERNION,
) -> Answer:
    """Noise-free pairs, rounded to doubles once: the turn that is missing from the fit, radians.

    The condition is how far the points reach from the origin over the second largest of their extents: that much
    a relative error of the coordinates, rounding included, can turn the fit.
    """
    truth = rotation(quaternion)
    stack_m = np.array(
        [
            [
                float(
                    exact.mpf(offset_m[i])
                    + exact.mpf(scale) * sum(truth[i][j] * exact.mpf(float(p[j])) for j in range(3))
                )
                for i in range(3)
            ]
            for p in sensor_m
        ]
    )
    found = fit(sensor_m, stack_m)[:3, :3]
    size = float(np.cbrt(np.linalg.det(found)))
    wrong = max(exact.distance(found[i, j] / size, truth[i][j]) for i in range(3) for j in range(3))
    fits = max(abs(size / scale - 1), wrong)
    condition = max(
        float(np.abs(points).max() / (np.linalg.svd(points - points.mean(0), compute_uv=False)[1] / len(points) ** 0.5))
        for points in (sensor_m, stack_m)
    )
    return Answer(fits, 16 * EPS64 * condition, condition, fits / condition)


def trials(fit: Fit) -> Iterator[Trial]:
    """Every case of the calibration; `fit` is the solver under trial, with the least-squares scale."""
    for power in (0, 1, 3, 5, 7):
        run = partial(recovered, fit, cloud(aspect=10.0**-power))
        yield Trial(STAGE, f"points 1e-{power} as wide as long", run, measure="rad")
    for metres in (1e2, 1e4, 1e6):
        run = partial(recovered, fit, cloud() + metres)
        yield Trial(STAGE, f"points {metres:g} m from the origin", run, measure="rad")
    for size_m in (1e-9, 1e-3, 1e3, 1e150):
        run = partial(recovered, fit, cloud(size_m=size_m), offset_m=(size_m, -size_m, 2 * size_m))
        yield Trial(STAGE, f"points within {size_m:g} m", run, measure="rad")
    for scale in (1e-3, 1e3):
        yield Trial(
            STAGE, f"scale {scale:g} (units mixed)", partial(recovered, fit, cloud(), scale=scale), measure="rad"
        )
    for name, quaternion in (("half a turn", HALF_TURN), ("no turn", (1, 0, 0, 0))):
        yield Trial(STAGE, name, partial(recovered, fit, cloud(), quaternion=quaternion), measure="rad")
    yield Trial(STAGE, "three pairs", partial(recovered, fit, cloud(count=3)), measure="rad")
    yield Trial(STAGE, "all points in one plane", partial(recovered, fit, cloud() * [1, 1, 0]), measure="rad")
    line = cloud(aspect=0.0)
    for name, points in (
        ("two pairs", cloud(count=2)),
        ("points at one place", np.repeat(cloud(count=1), 9, axis=0)),
        ("points on a line", line),
        ("points 1e-12 as wide as long", cloud(aspect=1e-12)),
        ("points 1e12 m from the origin", cloud() + 1e12),
        ("a point at NaN", np.where(np.arange(27)[:, None] == 5, np.nan, cloud())),
    ):
        yield refusal(STAGE, name, partial(recovered, fit, points))
