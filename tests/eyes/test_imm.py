"""The filters behind the tracker: against a textbook Kalman filter, and safe where numbers are extreme."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.eyes import imm

ACCELERATION = (0.002, 0.03, 0.5)


def textbook(measured: Any, times: Any, *, q: Any, variance: Any, speed: Any) -> Any:
    """A Kalman filter of [position, velocity] in matrices, one axis, Joseph form."""
    state, covariance = np.array([measured[0], 0.0]), np.diag([variance, speed**2])
    for z, dt in zip(measured[1:], np.diff(times)):
        f = np.array([[1, dt], [0, 1]])
        state, covariance = f @ state, f @ covariance @ f.T + q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        gain = covariance[:, 0] / (covariance[0, 0] + variance)
        keep = np.eye(2) - np.outer(gain, [1, 0])
        state = state + gain * (z - state[0])
        covariance = keep @ covariance @ keep.T + variance * np.outer(gain, gain)
    return state, covariance


def test_one_model_is_the_textbooks_kalman_filter() -> None:
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(0.01, 0.05, 60))
    measured = np.cumsum(random.normal(0, 0.01, (60, 3)), axis=0)
    models = imm.started(measured[0], count=1, variance=4e-6, speed=0.3)
    for place, dt in zip(measured[1:], np.diff(times)):
        models = imm.predicted(models, dt, acceleration=(0.1,), stay_s=1.0)
        models = imm.corrected(models, place, variance=4e-6)
    position, velocity = imm.combined(models)
    for axis in range(3):
        state, covariance = textbook(measured[:, axis], times, q=0.1, variance=4e-6, speed=0.3)
        assert position[axis] == pytest.approx(state[0], rel=1e-9)
        assert velocity[axis] == pytest.approx(state[1], rel=1e-9)
    (model,) = models
    assert [model.var_position, model.covariance, model.var_velocity] == pytest.approx(
        [covariance[0, 0], covariance[0, 1], covariance[1, 1]], rel=1e-6
    )


def test_mixing_matches_the_published_equations() -> None:
    random = np.random.default_rng(1)
    models = tuple(
        imm.Model(*random.normal(size=6), 0.1 + i, 0.05, 1.0 + i, w)  # type: ignore[call-arg]
        for i, w in enumerate((0.2, 0.3, 0.5))
    )
    (mixed, *_), dt, stay_s = imm.predicted(models, 1e-9, acceleration=ACCELERATION, stay_s=1e-9), 1e-9, 1e-9
    stay = np.exp(-dt / stay_s)
    shares = np.array([0.2 * stay, 0.3 * (1 - stay) / 2, 0.5 * (1 - stay) / 2])
    assert mixed.weight == pytest.approx(shares.sum())
    shares /= shares.sum()
    means = np.array([m[:6] for m in models])
    centre = shares @ means
    np.testing.assert_allclose(mixed[:6], centre, atol=1e-6)
    spread = ((means - centre)[:, :3] ** 2).sum(1) / 3
    assert mixed.var_position == pytest.approx(shares @ ([m.var_position for m in models] + spread), rel=1e-6)


@given(
    places=st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=2, max_size=30),
    steps=st.lists(st.floats(0, 1e4), min_size=30, max_size=30),
    variance=st.floats(1e-12, 1e3),
)
def test_covariances_stay_positive_and_everything_finite(places: Any, steps: Any, variance: Any) -> None:
    models = imm.started(places[0], count=3, variance=variance, speed=0.3)
    for place, dt in zip(places[1:], steps):
        models = imm.predicted(models, dt, acceleration=ACCELERATION, stay_s=0.5)
        models = imm.corrected(models, place, variance=variance)
        for m in models:
            assert np.isfinite(m).all() and m.var_position > 0 and m.var_velocity > 0 and m.weight > 0
            assert m.covariance**2 <= m.var_position * m.var_velocity * (1 + 1e-9)
        assert sum(m.weight for m in models) == pytest.approx(1.0)


def test_a_still_head_is_believed_calm_and_a_hasty_one_hasty() -> None:
    random, dt = np.random.default_rng(2), 1 / 60

    def weights(path: Any) -> Any:
        models = imm.started(path[0], count=3, variance=4.5e-6, speed=0.3)
        for place in path[1:] + random.normal(0, 0.002, path[1:].shape):
            models = imm.predicted(models, dt, acceleration=ACCELERATION, stay_s=0.5)
            models = imm.corrected(models, place, variance=4.5e-6)
        return [m.weight for m in models]

    times = np.arange(120) * dt
    still = np.zeros((120, 3))
    hasty = np.stack([0.15 * np.sin(8 * times), 0 * times, 0 * times], 1)
    assert np.argmax(weights(still)) == 0 and np.argmax(weights(hasty)) == 2


def test_how_sure_a_prediction_is_grows_with_the_horizon_and_is_the_mixture_s() -> None:
    """The reference draws from the mixture: model by weight, Gaussian position and velocity, noise on the way."""
    random = np.random.default_rng(3)
    acceleration = (0.01, 0.5)
    models = (
        imm.Model(0.0, 0.0, 0.6, 0.1, 0.0, 0.0, 4e-6, 1e-5, 1e-3, 0.7),
        imm.Model(0.004, 0.0, 0.6, 0.3, 0.1, 0.0, 9e-6, 2e-5, 4e-2, 0.3),
    )
    for ahead_s in (0.0, 0.05, 0.12):
        drawn = []
        for m, q in zip(models, acceleration, strict=True):
            covariance = [[m.var_position, m.covariance], [m.covariance, m.var_velocity]]
            states = random.multivariate_normal([0.0, 0.0], covariance, size=(round(200_000 * m.weight), 3))
            mean = np.array([m.x + m.u * ahead_s, m.y + m.v * ahead_s, m.z + m.w * ahead_s])
            noise = random.normal(0.0, (q * ahead_s**3 / 3) ** 0.5, states.shape[:2])
            drawn.append(mean + states[..., 0] + states[..., 1] * ahead_s + noise)
        axes = np.concatenate(drawn)
        expected = float(np.sqrt(axes.var(axis=0).mean()))
        assert imm.deviation(models, ahead_s, acceleration=acceleration) == pytest.approx(expected, rel=0.01)
