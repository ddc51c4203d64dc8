"""Against 50 digits: what float64 can still do, and that it refuses where it cannot."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.similarity import Degenerate, Similarity, extents, fit, fit_batch, rotation_rounding_rad

mp.mp.dps = 50
DIGITS = float(np.finfo(np.float64).eps)


def reference(sensor: np.ndarray, stack: np.ndarray) -> tuple[mp.mpf, mp.matrix, mp.matrix]:
    """The `inverse` similarity of the same float64 numbers, with 50 digits."""
    count = len(sensor)
    c, w = (mp.matrix(points.tolist()) for points in (sensor, stack))
    mean_c, mean_w = ([mp.fsum(m[:, axis]) / count for axis in range(3)] for m in (c, w))
    for row in range(count):
        for axis in range(3):
            c[row, axis] -= mean_c[axis]
            w[row, axis] -= mean_w[axis]
    left, values, right = mp.svd_r(c.T * w)
    sign = mp.sign(mp.det(left) * mp.det(right))
    rotation = (left * mp.diag([1, 1, sign]) * right).T
    scale = mp.fsum(x * x for x in w) / (values[0] + values[1] + sign * values[2])
    return scale, rotation, mp.matrix(mean_w) - scale * (rotation * mp.matrix(mean_c))


def forward_errors(found: Similarity, truth: tuple[mp.mpf, mp.matrix, mp.matrix]) -> tuple[float, float, float]:
    """Largest entry of the rotation's error, relative error of the scale, largest of the shift's."""
    scale, rotation, shift = truth
    turned = max(abs(mp.mpf(float(found.rotation[i, j])) - rotation[i, j]) for i in range(3) for j in range(3))
    moved = max(abs(mp.mpf(float(found.translation_m[i])) - shift[i]) for i in range(3))
    return float(turned), float(abs(mp.mpf(float(found.scale)) / scale - 1)), float(moved)


def backward_error_m(found: Similarity, truth: tuple[mp.mpf, mp.matrix, mp.matrix], sensor: np.ndarray) -> float:
    """By how much the calibrated points differ from the reference's: what a user sees."""
    scale, rotation, shift = truth
    exact = [scale * (rotation * mp.matrix(point.tolist())) + shift for point in sensor]
    told = found.points(sensor)
    return float(max(abs(mp.mpf(float(told[k, i])) - exact[k][i]) for k in range(len(sensor)) for i in range(3)))


def scene(
    *, aspect: float = 1.0, offset_m: float = 0.0, size_m: float = 0.1, scale: float = 1.0, noise_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """27 pairs along a line that is oblique to every axis: sensor, stack."""
    random = np.random.default_rng(0)
    line = random.normal(size=(27, 3)) * size_m * np.array([1, aspect, aspect])
    stack = Rotation.from_rotvec([0.7, -0.4, 1.1]).apply(line) + offset_m
    sensor = Rotation.from_rotvec([-1.2, 0.3, 0.5]).apply(stack - 0.3) / scale
    return sensor + noise_m * random.normal(size=stack.shape), stack


def bound_rad(*clouds: np.ndarray) -> float:
    return max(
        rotation_rounding_rad(second_extent_m=float(extents(p)[1]), magnitude_m=float(np.abs(p).max())) for p in clouds
    )


@pytest.mark.parametrize(
    "case",
    [
        {},
        {"noise_m": 0.01},
        {"scale": 1e-3},
        {"scale": 8.125},
        {"size_m": 1e-9, "offset_m": 0.5},
        {"offset_m": 1e3},
        {"offset_m": 1e6},
        {"aspect": 1e-3},
        {"aspect": 1e-3, "noise_m": 1e-7},
        {"aspect": 1e-3, "offset_m": 1e3},
        {"aspect": 1e-4},
        {"aspect": 1e-5},
        {"aspect": 1e-6},
        {"aspect": 1e-6, "scale": 1e-3},
        {"aspect": 1e-7},
        {"aspect": 1e-8},
    ],
    ids=str,
)
def test_the_error_stays_below_the_bound_that_decides_refusal(case: dict[str, float]) -> None:
    sensor, stack = scene(**case)
    found, truth = fit(sensor, stack, rule="inverse"), reference(sensor, stack)
    rotation, scale, shift = forward_errors(found, truth)
    bound = bound_rad(sensor, stack)
    assert rotation <= max(bound, 4 * DIGITS)
    assert scale <= max(bound**2, 16 * DIGITS)
    magnitude_m = float(np.abs(stack).max()) + found.scale * float(np.abs(sensor).max())
    assert shift <= (rotation + 16 * DIGITS) * 2 * magnitude_m
    assert backward_error_m(found, truth, sensor) <= 32 * DIGITS * magnitude_m


@pytest.mark.parametrize("case", [{"aspect": 10.0**-power} for power in (9, 10, 11, 12)] + [{"offset_m": 1e9}], ids=str)
def test_where_rounding_alone_would_turn_the_result_it_refuses(case: dict[str, float]) -> None:
    with pytest.raises(Degenerate, match="double precision"):
        fit(*scene(**case), rule="inverse")


def test_the_polish_saves_digits_that_the_covariance_alone_loses() -> None:
    """The plain SVD route squares the aspect: at 1e-6 it has lost what polishing keeps, a factor of 1e4 at least."""
    sensor, stack = scene(aspect=1e-6)
    truth = reference(sensor, stack)
    plain = forward_errors(fit_batch(sensor, stack, rule="inverse"), truth)[0]
    polished = forward_errors(fit(sensor, stack, rule="inverse"), truth)[0]
    assert polished < 1e-4 * plain


def test_a_mirrored_cloud_gets_the_same_best_rotation_as_with_50_digits() -> None:
    sensor, stack = scene()
    sensor = sensor * [1, 1, -1]
    rotation, _, _ = forward_errors(fit(sensor, stack, rule="inverse"), reference(sensor, stack))
    assert rotation < 1e-12


@pytest.mark.parametrize("unit", [1e-150, 1e-30, 1e30, 1e150])
def test_units_beyond_reason_neither_overflow_nor_underflow(unit: float) -> None:
    sensor, stack = scene()
    found = fit(sensor * unit, stack, rule="inverse")
    assert found.scale * unit == pytest.approx(float(fit(sensor, stack, rule="inverse").scale), rel=1e-12)
