"""The One Euro filter smooths a still point and follows a moving one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.eyes.one_euro import OneEuro, smoothing


def filtered(path: NDArray[np.float64], *, rate_hz: float = 60.0, **options: float) -> NDArray[np.float64]:
    euro = OneEuro(**options)
    return np.array([euro.update(p, dt_s=1 / rate_hz) for p in path])


def test_the_weight_of_a_sample_is_the_papers() -> None:
    assert smoothing(0.02, cutoff_hz=1.5) == pytest.approx(1 / (1 + (1 / (2 * np.pi * 1.5)) / 0.02))


def test_noise_of_a_still_point_is_reduced_and_its_mean_kept() -> None:
    noise = np.random.default_rng(0).normal(0, 0.003, (600, 3))
    out = filtered(noise, min_cutoff_hz=1.0, beta=1.0)
    assert out[100:].std() < 0.4 * noise.std() and abs(out[100:].mean()) < 0.0005


def test_a_higher_beta_follows_a_quick_movement_closer() -> None:
    times = np.arange(120) / 60
    path = np.stack([0.5 * times, 0 * times, 0 * times], 1)
    lags = [path[-1, 0] - filtered(path, beta=beta)[-1, 0] for beta in (0.0, 5.0, 50.0)]
    assert lags[0] > 2 * lags[1] > 4 * lags[2] > 0


def test_it_turns_with_the_frame() -> None:
    random = np.random.default_rng(3)
    path = np.cumsum(random.normal(0, 0.01, (50, 3)), axis=0)
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    np.testing.assert_allclose(filtered(path @ turn.T), filtered(path) @ turn.T, atol=1e-12)
