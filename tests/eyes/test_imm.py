"""Compares the tracker's filters with a textbook Kalman filter, also for extreme numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm

from runtime.eyes import imm

ACCELERATION = (0.05, 0.4, 2.0)
NOISE = np.array([[4e-6, 2e-7, 0.0], [2e-7, 2e-8, 0.0], [0.0, 0.0, 1e-8]])


def singer(dt_s: float, strength: float) -> tuple[Any, Any]:
    """Transition and noise of position, velocity and a fading acceleration, by Van Loan's matrix exponential."""
    change = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / imm.FADE_S]])
    added = np.diag([0.0, 0.0, 2 * strength**2 / imm.FADE_S])
    whole = expm(np.block([[-change, added], [np.zeros((3, 3)), change.T]]) * dt_s)
    step = whole[3:, 3:].T
    return np.kron(step, np.eye(3)), np.kron(step @ whole[:3, 3:], np.eye(3))


@pytest.mark.parametrize("strength", [0.05, 2.0])
def test_one_model_is_the_textbooks_kalman_filter_with_singers_acceleration(strength: float) -> None:
    random = np.random.default_rng(0)
    steps = random.uniform(0.005, 0.2, 60)
    places = np.cumsum(random.normal(0, 0.01, (61, 3)), axis=0)
    belief = imm.started(places[0], noise=NOISE, speed=0.3, acceleration=(strength,))
    state = np.r_[places[0], np.zeros(6)]
    covariance = np.kron(np.diag([0.0, 0.09, strength**2]), np.eye(3))
    covariance[:3, :3] = NOISE
    see = np.eye(3, 9)
    for place, dt_s in zip(places[1:], steps, strict=True):
        belief = imm.predicted(belief, dt_s, acceleration=(strength,), stay_s=1.0)
        step, added = singer(dt_s, strength)
        state, covariance = step @ state, step @ covariance @ step.T + added
        total = covariance[:3, :3] + NOISE
        expected = float((place - state[:3]) @ np.linalg.inv(total) @ (place - state[:3]))
        assert imm.surprise(belief, place, noise=NOISE) == pytest.approx(expected, rel=1e-3)
        belief = imm.corrected(belief, place, noise=NOISE)
        gain = covariance @ see.T @ np.linalg.inv(total)
        state = state + gain @ (place - state[:3])
        keep = np.eye(9) - gain @ see
        covariance = keep @ covariance @ keep.T + gain @ NOISE @ gain.T
    np.testing.assert_allclose(belief.state[0], state, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(belief.covariance[0], covariance, rtol=1e-4, atol=1e-9)


def test_mixing_matches_the_published_equations() -> None:
    random = np.random.default_rng(1)
    roots = random.normal(size=(3, 9, 9))
    belief = imm.Belief(random.normal(size=(3, 9)), roots @ roots.transpose(0, 2, 1), np.array([0.2, 0.3, 0.5]))
    mixed = imm.predicted(belief, 1e-12, acceleration=ACCELERATION, stay_s=1e-12)
    stay = np.exp(-1.0) + (1 - np.exp(-1.0)) / 3
    shares = np.array([0.2 * stay, 0.3 * (1 - stay) / 2, 0.5 * (1 - stay) / 2])
    assert mixed.weight[0] == pytest.approx(shares.sum())
    shares /= shares.sum()
    centre = shares @ belief.state
    apart = belief.state - centre
    spread = sum(w * (c + np.outer(d, d)) for w, c, d in zip(shares, belief.covariance, apart, strict=True))
    np.testing.assert_allclose(mixed.state[0], centre, atol=1e-6)
    np.testing.assert_allclose(mixed.covariance[0], spread, rtol=1e-6, atol=1e-6)


@given(
    places=st.lists(st.tuples(*[st.floats(-20, 20)] * 3), min_size=2, max_size=20),
    steps=st.lists(st.floats(0, 0.5), min_size=20, max_size=20),
    sigmas=st.tuples(*[st.floats(2e-5, 1.0)] * 3),
)
@example(
    places=[(0, 0, 0), (0, 2, 0), (0, 0, 10), (0, 0, 13), (0, 1, 0), (0, 0, 0)],
    steps=[0.5, 0.03125, 0.25, 6e-8, 0.5],
    sigmas=(1.0, 0.125, 2e-5),
)
@example(
    places=[(0, 0, 0), (0, 1, 0), (8, 4, 3), *[(0, 0, 0)] * 3, (14, 0, 0), (1, 0, 0), (0, -14, -2), (0, 0, 0)],
    steps=[0, 0, 0.5, 0, 0, 0.001953125, 0.5, 1.192092896e-07, 0.375],
    sigmas=(2e-5, 2e-5, 2e-5),
)
def test_covariances_stay_positive_and_everything_finite(places: Any, steps: Any, sigmas: Any) -> None:
    noise = np.diag(np.square(sigmas))
    belief = imm.started(np.array(places[0]), noise=noise, speed=0.3, acceleration=ACCELERATION)
    for place, dt_s in zip(places[1:], steps, strict=False):
        belief = imm.predicted(belief, dt_s, acceleration=ACCELERATION, stay_s=0.5)
        belief = imm.corrected(belief, np.array(place), noise=noise)
        assert np.isfinite(belief.state).all() and (belief.weight > 0).all()
        for covariance in belief.covariance:
            size = np.sqrt(np.diag(covariance))
            assert np.linalg.eigvalsh(covariance / np.outer(size, size)).min() > -1e-9
        assert belief.weight.sum() == pytest.approx(1.0)


def test_a_still_head_is_believed_calm_and_a_hasty_one_hasty() -> None:
    random, dt_s, noise = np.random.default_rng(2), 1 / 60, np.eye(3) * 0.002**2

    def weights(path: Any) -> Any:
        belief = imm.started(path[0], noise=noise, speed=0.3, acceleration=ACCELERATION)
        for place in path[1:] + random.normal(0, 0.002, path[1:].shape):
            belief = imm.predicted(belief, dt_s, acceleration=ACCELERATION, stay_s=0.5)
            belief = imm.corrected(belief, place, noise=noise)
        return belief.weight

    times = np.arange(120) * dt_s
    assert np.argmax(weights(np.zeros((120, 3)))) == 0
    assert np.argmax(weights(np.stack([0.15 * np.sin(8 * times), 0 * times, 0 * times], 1))) == 2


def test_how_far_a_prediction_is_off_is_the_mixture_s() -> None:
    """The reference draws from the mixture: model by weight, Gaussian state, noise on the way."""
    random, about = np.random.default_rng(3), np.array([0.01, 0.0, 0.6])
    roots = random.normal(0, 0.01, (2, 9, 9))
    belief = imm.Belief(random.normal(0, 0.05, (2, 9)), roots @ roots.transpose(0, 2, 1), np.array([0.7, 0.3]))
    for ahead_s in (0.01, 0.05, 0.3):
        drawn = []
        for state, covariance, weight, strength in zip(*belief, (0.4, 2.0), strict=True):
            step, added = singer(ahead_s, strength)
            count = round(300_000 * weight)
            states = random.multivariate_normal(step @ state, step @ covariance @ step.T + added, size=count)
            drawn.append(states[:, :3])
        off = np.concatenate(drawn) - about
        found = imm.spread(belief, ahead_s, acceleration=(0.4, 2.0), about=about)
        np.testing.assert_allclose(found, off.T @ off / len(off), rtol=0.02, atol=2e-5)
        np.testing.assert_allclose(imm.ahead(belief, ahead_s), np.concatenate(drawn).mean(0), atol=5e-4)
