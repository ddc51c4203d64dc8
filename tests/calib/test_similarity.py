"""Tests that closed forms recover exact data, that each scale is optimal, and that bad data are refused or left out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.similarity import Degenerate, fit, fit_batch, fit_robust
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
    found = fit(camera(points, rotation=rotation, scale=scale, shift=shift), points, rule=rule)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.translation_m, shift, atol=1e-7)


def test_noise_on_the_sensors_side_shrinks_least_squares_and_not_inverse() -> None:
    random = np.random.default_rng(0)
    points = np.broadcast_to(cloud(1), (2000, 27, 3))
    sensor = points + random.normal(scale=0.03, size=points.shape)
    shrunk, true = (fit_batch(sensor, points, rule=rule).scale.mean() for rule in ("least-squares", "inverse"))
    assert shrunk < 0.95
    assert true == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (cloud(0, 2), "at least 3"),
        (np.ones((5, 3)), "coincide"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "one line"),
        (np.outer(np.arange(5.0), [1, 2, 3]) + 1e-8 * cloud(0, 5), "double precision"),
        (1e12 + cloud(0, 5), "double precision"),
        (np.full((4, 3), np.nan), "finite"),
    ],
)
def test_points_that_determine_nothing_are_refused(points: NDArray[np.float64], why: str) -> None:
    with pytest.raises(Degenerate, match=why):
        fit(points, points, rule="inverse")
    with pytest.raises(Degenerate, match=why):
        fit(points, cloud(0, len(points)), rule="inverse")


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


def test_many_pairs_are_scored_by_a_sample_and_rejected_one_by_one() -> None:
    volume = viewing_volume_m()
    points = np.random.default_rng(0).uniform(volume.min(0), volume.max(0), size=(5000, 3))
    wrong = list(range(0, 5000, 5))
    found = fit_robust(spoiled(measured(points, sigma_m=0.003), wrong), points)
    assert not found.inlier[wrong].any()
    assert found.inlier.sum() >= 0.998 * 4000
