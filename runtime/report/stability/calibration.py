"""Calibration cases (supplement, (15)-(28)) where point pairs barely determine a known similarity."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from runtime.records import F64
from runtime.report.stability.trial import EPS64, Answer, Trial

STAGE = "calibration"
Fit = Callable[[F64, F64], F64]  # maps (K, 3) points in `sensor` and in `stack`, metres, to the 4x4 stack_from_sensor
TURN = Rotation.from_quat([-1, 3, 5, 2]).as_matrix()
HALF_TURN = Rotation.from_quat([1, 2, 2, 0]).as_matrix()


def cloud(*, aspect: float = 1.0, size_m: float = 0.3, count: int = 27) -> F64:
    """Return random points in a box, `size_m` half its extent along x; y and z are `aspect` times that."""
    return np.random.default_rng(11).uniform(-1, 1, (count, 3)) * [size_m, size_m * aspect, size_m * aspect]


def fitted(
    fit: Fit,
    sensor_m: F64,
    *,
    scale: float = 1.0,
    offset_m: tuple[float, float, float] = (0.1, -0.4, 0.3),
    turn: F64 = TURN,
) -> Answer:
    """Transform points (K, 3) by a known similarity, and compare the fitted similarity with the known
    one. The condition number is the points' largest coordinate divided by their RMS extent along the second principal
    axis, in the worse frame. Relative errors in the coordinates, including rounding, rotate the fit by this factor.
    """
    stack_m = scale * sensor_m @ turn.T + offset_m
    matrix = fit(sensor_m, stack_m)
    if matrix.shape != (4, 4) or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        return Answer(math.nan, 0.0, note="no transform")
    mapped_m = sensor_m @ matrix[:3, :3].T + matrix[:3, 3]
    error = float(
        max(np.abs(mapped_m - stack_m).max() / np.abs(stack_m).max(), np.abs(matrix[:3, :3] / scale - turn).max())
    )
    condition = max(
        float(np.abs(p).max() / np.linalg.svd(p - p.mean(0), compute_uv=False)[1] * len(p) ** 0.5)
        for p in (sensor_m, stack_m)
    )
    return Answer(error, 16 * EPS64 * condition, condition, error / condition)


def trials(fits: Mapping[str, Fit]) -> Iterator[Trial]:
    """Yield all trials for calibration, of which only `least-squares` is tested on the extreme cases."""
    for rule, solver in fits.items():
        yield Trial(STAGE, f"{rule}: a usual cloud", partial(fitted, solver, cloud()), measure="rad")
    fit = partial(fitted, fits["least-squares"])
    cases: dict[str, Callable[[], Answer]] = {
        **{
            f"points 1e-{power} as wide as long": partial(fit, cloud(aspect=10.0**-power) @ TURN)
            for power in (0, 1, 3, 5, 7)
        },
        **{f"points {metres:g} m from the origin": partial(fit, cloud() + metres) for metres in (1e2, 1e4, 1e6)},
        **{
            f"points within {size:g} m": partial(fit, cloud(size_m=size), offset_m=(size, -size, 2 * size))
            for size in (1e-9, 1e-3, 1e3, 1e150)
        },
        **{f"scale {scale:g} (units mixed)": partial(fit, cloud(), scale=scale) for scale in (1e-3, 1e3)},
        "half a turn": partial(fit, cloud(), turn=HALF_TURN),
        "no turn": partial(fit, cloud(), turn=np.eye(3)),
        "three pairs": partial(fit, cloud(count=3)),
        "all points in one plane": partial(fit, cloud() * [1, 1, 0]),
    }
    for name, case in cases.items():
        yield Trial(STAGE, name, case, measure="rad")
