"""Gross errors are found, named and left out; good pairs are not."""

from __future__ import annotations

import numpy as np
import pytest

from calib.robust import fit_robust
from calib.viewpoints import viewing_volume_m
from tests.calib.camera import KNOWN_M, measured


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
