"""Tests the actual and expected error at the eye of each method."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.solution import METHODS, Method, design_covariance, solve, solve_default
from calib.viewpoints import grid, viewing_volume_m
from tests.calib.camera import KNOWN_M, measured

SIGMAS_M = (0.0, 0.001, 0.003, 0.010, 0.030)
CAMERA_M = (0.05, 0.02, 0.22)


def errors_m2(methods: Sequence[Method], *, seed: int, sigma_m: float, scale: float) -> np.ndarray:
    """(methods and the default, points) squared position errors over the viewing volume after calibration at 27
    viewpoints, with a random camera rotation and sensor noise; the sensor's metre is `scale` of ours."""
    known_m, volume_m = np.array([viewpoint.midpoint_m for viewpoint in grid()]), viewing_volume_m()
    random = np.random.default_rng(seed)
    turn = Rotation.random(rng=random).as_matrix()
    sensor, seen = ((points - CAMERA_M) @ turn / scale for points in (known_m, volume_m))
    sensor = sensor + sigma_m * random.normal(size=sensor.shape)
    found = [*(solve(sensor, known_m, method=name) for name in methods), solve_default(sensor, known_m)]
    return np.array([((each.similarity.points(seen) - volume_m) ** 2).sum(-1) for each in found])


@cache
def mean_error_m(*, sigma_m: float, scale: float = 1.0, seeds: int = 60) -> dict[str, float]:
    squares = [errors_m2(METHODS, seed=seed, sigma_m=sigma_m, scale=scale) for seed in range(seeds)]
    return dict(zip([*METHODS, "default"], np.sqrt(squares).mean((0, 2)).tolist(), strict=True))


@pytest.mark.parametrize("sigma_m", SIGMAS_M)
def test_the_default_is_within_four_percent_of_the_best(sigma_m: float) -> None:
    means = mean_error_m(sigma_m=sigma_m)
    assert means["default"] <= 1.04 * min(means[method] for method in METHODS) + 1e-12


@pytest.mark.parametrize("scale", [0.95, 1.1])
@pytest.mark.parametrize("sigma_m", [0.001, 0.003])
def test_with_a_wrong_metre_the_default_is_nearly_the_best(scale: float, sigma_m: float) -> None:
    means = mean_error_m(sigma_m=sigma_m, scale=scale)
    assert means["default"] <= 1.02 * min(means[method] for method in METHODS)
    assert means["fixed-scale"] > 2 * means["default"]


@pytest.mark.parametrize(("sigma_m", "excess"), [(0.001, 0.01), (0.003, 0.03), (0.005, 0.04), (0.01, 0.04)])
def test_hidden_points_are_nearly_as_well_placed_as_by_the_best_method(sigma_m: float, excess: float) -> None:
    """RMS over 240 sensors that are off by up to a tenth. No rule has the least error with a right metre and with every
    wrong one: `inverse` always costs 11 to 13% with a right one, where the default may cost 4% (above)."""
    scales = np.random.default_rng(9).uniform(0.9, 1.1, size=240)
    names = [name for name in METHODS if name != "robust"]
    squares = np.array([errors_m2(names, seed=n, sigma_m=sigma_m, scale=s).mean(-1) for n, s in enumerate(scales)])
    rms_m = dict(zip([*names, "default"], np.sqrt(squares.mean(0)), strict=True))
    assert rms_m["default"] <= (1 + excess) * min(rms_m[name] for name in names)


@pytest.mark.parametrize("method", ["inverse", "fixed-scale"])
def test_the_predicted_error_at_the_eye_is_the_real_one(method: str) -> None:
    """200 noise samples: the RMS over samples against the covariance's promise, at every point of the volume."""
    volume = viewing_volume_m()
    seen = measured(volume)
    squares, promised = np.zeros(len(volume)), np.zeros(len(volume))
    for seed in range(200):
        found = solve(measured(sigma_m=0.003, seed=seed), KNOWN_M, method=method)
        squares += ((found.similarity.points(seen) - volume) ** 2).sum(-1) / 200
        promised += found.eye_error_m(volume) ** 2 / 200
    ratio = np.sqrt(squares / promised)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.06)
    assert 0.8 < ratio.min() <= ratio.max() < 1.2


def test_pairs_without_any_noise_leave_no_uncertainty() -> None:
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    found = solve_default(corners, corners)
    assert found.noise_m == 0.0 and found.unit_covariance[6, 6] == 0.0


@pytest.mark.parametrize("fixed_scale", [False, True])
def test_a_design_that_leaves_a_rotation_open_has_no_finite_error(fixed_scale: bool) -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    _, covariance, condition = design_covariance(line, fixed_scale=fixed_scale)
    assert np.isinf(condition) and np.isinf(covariance[:6, :6]).all()
    _, covariance, condition = design_covariance(line + np.eye(5, 3), fixed_scale=fixed_scale)
    assert np.isfinite(condition) and np.isfinite(covariance).all()
