"""The EyeReal's synthetic experiment: which method is best at the eye (fewer noise samples than the command's 200)."""

from __future__ import annotations

import pytest

from calib.experiment import DEFAULT, SIGMAS_M, Case, run_case, time_solvers
from calib.solution import METHODS

SEEDS = 60


@pytest.fixture(scope="module")
def clean() -> dict[float, Case]:
    return {sigma: run_case(sigma_m=sigma, seeds=SEEDS) for sigma in SIGMAS_M}


def test_the_default_is_within_two_percent_of_the_best_at_every_sigma(clean: dict[float, Case]) -> None:
    for case in clean.values():
        best = min(case.mean_m[method] for method in METHODS)
        assert case.mean_m[DEFAULT] <= 1.02 * best + 1e-12


def test_the_residual_of_least_squares_is_never_above_the_seeds(clean: dict[float, Case]) -> None:
    for case in clean.values():
        assert case.rms_residual_m["least-squares"] <= case.rms_residual_m["seed"] * (1 + 1e-12) + 1e-15


def test_without_noise_every_method_is_exact(clean: dict[float, Case]) -> None:
    assert max(clean[0.0].p95_m.values()) < 1e-12


def test_the_error_grows_with_the_noise(clean: dict[float, Case]) -> None:
    for method in METHODS:
        means = [clean[sigma].mean_m[method] for sigma in SIGMAS_M]
        assert means == sorted(means)


def test_least_squares_is_the_worst_where_the_sensor_is_noisy(clean: dict[float, Case]) -> None:
    case = clean[0.030]
    assert case.mean_m["least-squares"] > case.mean_m["seed"] > case.mean_m["inverse"]


@pytest.mark.parametrize("sigma_m", [0.003, 0.030])
def test_robust_with_a_fifth_of_gross_errors_is_within_half_again_of_the_default_without(
    clean: dict[float, Case], sigma_m: float
) -> None:
    dirty = run_case(sigma_m=sigma_m, outliers=True, seeds=SEEDS)
    assert dirty.mean_m["robust"] <= 1.5 * clean[sigma_m].mean_m[DEFAULT]
    assert dirty.mean_m["inverse"] > 2 * dirty.mean_m["robust"]


@pytest.mark.parametrize("true_scale", [1.0, 0.95, 1.1])
@pytest.mark.parametrize("sigma_m", [0.001, 0.003])
def test_the_default_is_within_one_percent_of_the_best_whatever_the_sensors_metre(
    true_scale: float, sigma_m: float
) -> None:
    case = run_case(sigma_m=sigma_m, sensor_scale=true_scale, seeds=200)
    assert case.mean_m[DEFAULT] <= 1.01 * min(case.mean_m[method] for method in METHODS)


def test_a_sensor_with_a_metre_of_its_own_is_not_forced_to_ours() -> None:
    case = run_case(sigma_m=0.001, sensor_scale=1.03, seeds=20)
    assert case.mean_m[DEFAULT] < 1.02 * case.mean_m["inverse"]
    assert case.mean_m["fixed-scale"] > 5 * case.mean_m[DEFAULT]


def test_more_pairs_cost_time_and_gain_accuracy() -> None:
    timings = {(t.method, t.pairs): t for t in time_solvers([27, 10_000], repeat=5)}
    few, many = timings["closed form", 27], timings["closed form", 10_000]
    assert many.error_m < few.error_m / 5
    assert few.ms_p50 < many.ms_p50
    assert few.ms_p50 < timings["robust", 27].ms_p50
