"""Tests that closed forms recover exact data, that each scale is optimal, and that bad data are refused or left out."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.similarity import Degenerate, ScaleRule, extents, fit, fit_batch, fit_robust
from calib.viewpoints import viewing_volume_m
from tests.calib.camera import KNOWN_M, measured

RULES = ["seed", "least-squares", "inverse"]


def cloud(seed: int, count: int = 27) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.08, 0.1, 0.06] + [0.5, 0.0, 0.1]


def camera(points: np.ndarray, *, rotation: Rotation, scale: float, shift: np.ndarray) -> np.ndarray:
    return rotation.inv().apply(points - shift) / scale


rotations = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(rng=np.random.default_rng(seed)))
scales = st.floats(1e-4, 1e4)
shifts = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)


@settings(deadline=None)
@given(st.integers(0, 1000), st.integers(3, 40), rotations, scales, shifts, st.sampled_from(RULES))
def test_exact_pairs_give_the_similarity_back(
    seed: int, count: int, rotation: Rotation, scale: float, shift: NDArray[np.float64], rule: str
) -> None:
    points = cloud(seed, count)
    sensor = camera(points, rotation=rotation, scale=scale, shift=shift)
    np.testing.assert_allclose(fit_batch(sensor[None], points[None], rule=rule).points(sensor)[0], points, atol=1e-6)
    found = fit(sensor, points, rule=rule)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.translation_m, shift, atol=1e-7)
    moved = found.matrix @ [1.0, 2.0, 3.0, 1.0]
    np.testing.assert_allclose(moved, [*(scale * rotation.apply([1.0, 2.0, 3.0]) + shift), 1.0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("rule", [*RULES, 0.02])
def test_a_long_thin_cloud_is_turned_as_well_about_its_length(rule: ScaleRule) -> None:
    lying = np.random.default_rng(0).normal(size=(27, 3)) * [1e-5, 1.0, 2e-5] + [0.5, 0.0, 0.1]
    points = Rotation.from_rotvec([1.0, 0.5, 0.7]).apply(lying)
    rotation, shift = Rotation.from_rotvec([0.3, 1.0, -2.0]), np.array([1.0, 2.0, 3.0])
    found = fit(camera(points, rotation=rotation, scale=0.02, shift=shift), points, rule=rule)
    assert found.scale == pytest.approx(0.02, rel=1e-12)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(found.translation_m, shift, atol=1e-8)


def test_many_points_far_away_are_fitted_to_their_rounding() -> None:
    sensor = np.rint((10 * cloud(0, 5000) + [1e8, -3e7, 5e7]) * 2**20) / 2**20  # exact, as `stack` is
    stack = 2 * sensor[:, [1, 2, 0]] - [2e8, 3e7, 7e7]
    np.testing.assert_allclose(fit(sensor, stack, rule="inverse").points(sensor), stack, rtol=0, atol=2e-7)


def test_extents_are_rms_lengths_along_the_principal_axes_largest_first() -> None:
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 3, 0], [0, -3, 0], [0, 0, 2], [0, 0, -2]]) + 7.0
    np.testing.assert_allclose(extents(points) ** 2, [3.0, 4 / 3, 1 / 3], rtol=1e-12)
    assert extents(np.array([[0.0, 0, 0], [0, 2, 0]])).tolist() == [1, 0, 0]
    assert extents(np.ones((4, 3))).tolist() == [0, 0, 0]


def test_points_are_refused_from_where_rounding_turns_by_a_microradian() -> None:
    points = cloud(0, 5)
    far = points + np.array([extents(points)[1] / (4 * np.finfo(float).eps) * 1e-6, 0.0, 0.0])
    fit(points, 0.9 * (far - points) + points, rule="inverse")
    with pytest.raises(Degenerate, match="double precision"):
        fit(points, 1.1 * (far - points) + points, rule="inverse")


def test_noise_on_the_sensors_side_shrinks_least_squares_and_not_inverse() -> None:
    random = np.random.default_rng(0)
    points = np.broadcast_to(cloud(1), (2000, 27, 3))
    sensor = points + random.normal(scale=0.03, size=points.shape)
    shrunk, true = (fit_batch(sensor, points, rule=rule).scale.mean() for rule in ("least-squares", "inverse"))
    assert shrunk < 0.95 and true == pytest.approx(1.0, abs=0.02)
    each = [fit_batch(sensor, points, rule=rule).scale for rule in ("seed", "least-squares", "inverse")]
    np.testing.assert_allclose(each[0] ** 2, each[1] * each[2])  # `seed` is the geometric mean
    assert (fit_batch(sensor, points, rule=0.5).scale == 0.5).all()


@pytest.mark.parametrize(("points", "why"), [
    (cloud(0, 2), "at least 3"), (np.ones((5, 3)), "coincide"), (np.zeros((5, 3)), "coincide"),
    (np.outer(np.arange(5.0), [1, 2, 3]), "one line"), (1e12 + cloud(0, 5), "double precision"),
    (np.outer(np.arange(5.0), [1, 2, 3]) + 1e-8 * cloud(0, 5), "double precision"), (np.full((4, 3), np.nan), "finite"),
])  # fmt: skip
def test_points_that_determine_nothing_are_refused(points: NDArray[np.float64], why: str) -> None:
    for stack in (points, cloud(0, len(points))):
        with pytest.raises(Degenerate, match=why):
            fit(points, stack, rule="inverse")


@pytest.mark.parametrize("rule", ["least-squares", "inverse"])
def test_points_without_correlation_are_refused(rule: ScaleRule) -> None:
    cube = np.array(list(product((-1.0, 1.0), repeat=3)))
    with pytest.raises(Degenerate, match="not correlated"):
        fit(cube, cube * np.roll(cube, 1, axis=1), rule=rule)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_least_squares_scale_is_best_even_for_mirrored_points(mirrored: bool) -> None:
    random = np.random.default_rng(3)
    points = cloud(4)
    sensor = points * [1, 1, -1 if mirrored else 1] + random.normal(scale=0.01, size=points.shape)
    found = fit_batch(sensor[None], points[None], rule="least-squares")
    centred, target = sensor - sensor.mean(0), points - points.mean(0)
    turned = centred @ found.rotation[0].T
    assert np.linalg.det(found.rotation[0]) == pytest.approx(1.0)
    assert found.scale[0] == pytest.approx((turned * target).sum() / (centred**2).sum(), rel=1e-9)


def spoiled(sensor: np.ndarray, wrong: list[int], *, by_m: float = 0.3) -> np.ndarray:
    random = np.random.default_rng(1)
    direction = random.normal(size=(len(wrong), 3))
    sensor = sensor.copy()
    sensor[wrong] += by_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return sensor


@pytest.mark.parametrize("sigma_m", [0.0, 0.001, 0.01])
@pytest.mark.parametrize("wrong", [[], [0], [3, 9, 12, 20, 26], [0, 1, 2, 3, 4, 5, 6, 7]])
def test_exactly_the_wrong_pairs_are_left_out(sigma_m: float, wrong: list[int]) -> None:
    found = fit_robust(spoiled(measured(sigma_m=sigma_m), wrong), KNOWN_M)
    assert np.flatnonzero(~found.inlier).tolist() == wrong


@pytest.mark.parametrize(("count", "left_out"), [(5, []), (6, [1]), (7, [1])])
def test_five_pairs_have_no_majority_and_six_have_one(count: int, left_out: list[int]) -> None:
    known = KNOWN_M[[0, 5, 7, 13, 17, 22, 26][:count]]
    found = fit_robust(spoiled(measured(known, sigma_m=0.001), [1]), known)
    assert np.flatnonzero(~found.inlier).tolist() == left_out


@pytest.mark.parametrize("count", [3, 4, 5, 6, 8, 12])
def test_few_noisy_pairs_stay_and_one_5_cm_off_does_not(count: int) -> None:
    """The half that agrees best is smaller than the noise, most of all if it is small."""
    left_out = stayed = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        known = KNOWN_M[random.permutation(27)[:count]]
        sensor = measured(known, sigma_m=0.0) + random.normal(scale=0.003, size=(count, 3))
        left_out += np.count_nonzero(~fit_robust(sensor, known).inlier)
        stayed += fit_robust(sensor + [[0.0, 0.0, 0.05 * (n == 0)] for n in range(count)], known).inlier[0]
    assert left_out <= 0.01 * 40 * count and (count > 5 or not left_out)
    assert stayed == (0 if count > 5 else 40)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("noise_m", "off_m"), [(0.003, 0.0175), (0.0, 5.9e-13)])
def test_a_pair_is_compared_with_the_noise_of_all_that_stay(size: float, noise_m: float, off_m: float) -> None:
    """Exact pairs may be off by roundings of 4.6e-12 of their RMS distance from their centre, 12.8 cm."""
    for share, left_out in ((0.98, []), (1.02, [1])):
        sensor = measured(sigma_m=noise_m, seed=3) + np.eye(27)[1][:, None] * [share * off_m, 0.0, 0.0]
        assert np.flatnonzero(~fit_robust(size * sensor, size * KNOWN_M).inlier).tolist() == left_out


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("still", [4, 8, 12])
def test_pairs_of_a_sensor_that_stood_still_are_left_out(still: int) -> None:
    sensor = measured(sigma_m=0.003)
    sensor[1:still] = sensor[0]
    assert np.flatnonzero(~fit_robust(sensor, KNOWN_M).inlier).tolist() == [*range(1, still)]


def test_a_majority_with_noise_outvotes_pairs_that_agree_exactly() -> None:
    wrong = np.arange(1, 23, 2)  # 11 of 27
    sensor = measured(sigma_m=0.003)
    sensor[wrong] = measured(KNOWN_M + np.array([0.1, 0.2, 0.0]))[wrong]
    assert np.array_equal(np.flatnonzero(~fit_robust(sensor, KNOWN_M).inlier), wrong)


def test_many_pairs_are_scored_by_a_sample_and_rejected_one_by_one() -> None:
    volume = viewing_volume_m()
    points = np.random.default_rng(0).uniform(volume.min(0), volume.max(0), size=(5000, 3))
    wrong = list(range(0, 5000, 5))
    sensor = spoiled(measured(points, sigma_m=0.003), wrong)
    sensor[[1, 2]] = measured(points)[[1, 2]] + [[4.5 * 0.003, 0.0, 0.0], [0.0, 4.7 * 0.003, 0.0]]
    found = fit_robust(sensor, points)
    assert found.inlier[[1, 2]].tolist() == [True, False]  # the limit is 4.6 standard deviations
    assert not found.inlier[wrong].any() and found.inlier.sum() >= 0.998 * 4000
