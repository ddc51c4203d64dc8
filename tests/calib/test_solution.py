"""What a solution says of its own error is what repeated noise shows."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from calib.solution import solve, solve_default
from calib.viewpoints import viewing_volume_m
from tests.calib.camera import KNOWN_M, measured


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
    assert found.noise_m == 0.0
    assert found.unit_covariance[6, 6] == 0.0
