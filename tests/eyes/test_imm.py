"""Compares the tracker's filters with the textbooks' equations, also for extreme numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from runtime.eyes import imm

ACCELERATION = (0.05, 0.4, 2.0)
MODELS = imm.Models.of(ACCELERATION, stay_s=0.5)
NOISE = np.array([[4e-6, 2e-7, 0.0], [2e-7, 2e-8, 0.0], [0.0, 0.0, 1e-8]])


def singer(dt_s: float, strength: float) -> tuple[Any, Any]:
    """Transition and noise of position, velocity and a fading acceleration, by Van Loan's matrix exponential."""
    change = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / 0.25]])
    added = np.diag([0.0, 0.0, 2 * strength**2 / 0.25])
    whole = expm(np.block([[-change, added], [np.zeros((3, 3)), change.T]]) * dt_s)
    step = whole[3:, 3:].T
    return np.kron(step, np.eye(3)), np.kron(step @ whole[:3, 3:], np.eye(3))


class Textbook:
    """Reference: one quantity's models, by the published equations and one at a time."""

    def __init__(self, place: Any, *, speed: float, strengths: tuple[float, ...], stay_s: float) -> None:
        self.strengths, self.stay_s = strengths, stay_s
        self.states = [np.r_[place, np.zeros(6)] for _ in strengths]
        self.covariances = [np.kron(np.diag([0.0, speed**2, strength**2]), np.eye(3)) for strength in strengths]
        for covariance in self.covariances:
            covariance[:3, :3] = NOISE
        self.weights = np.full(len(strengths), 1 / len(strengths))

    def predict(self, dt_s: float) -> None:
        count, stay = len(self.weights), np.exp(-dt_s / self.stay_s)
        change = stay * np.eye(count) + (1 - stay) / count
        shares = self.weights[:, None] * change
        self.weights = shares.sum(0)
        mixed = []
        for share in (shares / self.weights).T:
            centre = sum(w * state for w, state in zip(share, self.states, strict=True))
            parts = zip(share, self.states, self.covariances, strict=True)
            mixed.append((centre, sum(w * (c + np.outer(x - centre, x - centre)) for w, x, c in parts)))
        for index, (state, covariance) in enumerate(mixed):
            step, added = singer(dt_s, self.strengths[index])
            self.states[index], self.covariances[index] = step @ state, step @ covariance @ step.T + added

    def correct(self, place: Any) -> Any:
        """Squared Mahalanobis distance to each model."""
        see, likely, distances = np.eye(3, 9), [], []
        for index, (state, covariance) in enumerate(zip(self.states, self.covariances, strict=True)):
            total, off = see @ covariance @ see.T + NOISE, place - see @ state
            likely.append(multivariate_normal.logpdf(off, cov=total))
            distances.append(off @ np.linalg.inv(total) @ off)
            gain = covariance @ see.T @ np.linalg.inv(total)
            keep = np.eye(9) - gain @ see
            self.states[index] = state + gain @ off
            self.covariances[index] = keep @ covariance @ keep.T + gain @ NOISE @ gain.T
        weights = self.weights * np.exp(likely - np.max(likely)) + 1e-6
        self.weights = weights / weights.sum()
        return distances

    def place_after(self, ahead_s: float) -> tuple[Any, Any]:
        """Mean and covariance of the position."""
        predicted = []
        for state, covariance, strength in zip(self.states, self.covariances, self.strengths, strict=True):
            step, added = singer(ahead_s, strength)
            predicted.append(((step @ state)[:3], (step @ covariance @ step.T + added)[:3, :3]))
        mean = sum(w * m for w, (m, _) in zip(self.weights, predicted, strict=True))
        parts = zip(self.weights, predicted, strict=True)
        return mean, sum(w * (c + np.outer(m - mean, m - mean)) for w, (m, c) in parts)


@pytest.mark.parametrize("accelerations", [[(0.05,)], [(2.0,)], [ACCELERATION], [ACCELERATION, (0.03, 0.4)]])
def test_the_filters_differ_from_the_textbooks_equations_by_rounding_only(accelerations: Any) -> None:
    random = np.random.default_rng(0)
    models = imm.Models.of(*accelerations, stay_s=0.5)
    places = np.cumsum(random.normal(0, 0.003, (61, len(accelerations), 3)), axis=0)
    speeds = (0.3, 0.1)[: len(accelerations)]
    belief = imm.started(places[0], noise=NOISE, speeds=speeds, models=models)
    books = [
        Textbook(place, speed=speed, strengths=strengths, stay_s=0.5)
        for place, speed, strengths in zip(places[0], speeds, accelerations, strict=True)
    ]
    for place, dt_s in zip(places[1:], random.uniform(0.005, 0.2, 60), strict=True):
        belief = imm.predicted(belief, dt_s, models=models)
        seen = imm.innovation(belief, place, noise=NOISE, models=models)
        belief = imm.corrected(belief, seen, models=models)
        for book in books:
            book.predict(dt_s)
        distances = [book.correct(each) for book, each in zip(books, place, strict=True)]
        np.testing.assert_allclose(seen.chi2, np.concatenate(distances), rtol=1e-8)
        assert imm.surprise(seen, models=models) == pytest.approx(max(map(min, distances)), rel=1e-8)
        np.testing.assert_allclose(belief.weight, np.concatenate([book.weights for book in books]), rtol=1e-7)
    np.testing.assert_allclose(belief.state, np.concatenate([book.states for book in books]), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(
        belief.covariance, np.concatenate([book.covariances for book in books]), rtol=1e-7, atol=1e-12
    )
    now = imm.moments(belief, models=models)
    for ahead_s in (0.0, 1e-6, 0.04, 1.0):
        expected = [book.place_after(ahead_s) for book in books]
        np.testing.assert_allclose(imm.ahead(now, ahead_s), [mean for mean, _ in expected], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(imm.spread(now, ahead_s), sum(each for _, each in expected), rtol=1e-7, atol=1e-12)


def test_time_steps_outside_the_power_series_range_are_refused() -> None:
    belief = imm.started(np.zeros((1, 3)), noise=NOISE, speeds=(0.3,), models=MODELS)
    for dt_s in (-1e-9, 1.1, np.nan):
        with pytest.raises(ValueError, match="time step"):
            imm.predicted(belief, dt_s, models=MODELS)


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
    belief = imm.started(np.array(places[:1]), noise=noise, speeds=(0.3,), models=MODELS)
    for place, dt_s in zip(places[1:], steps, strict=False):
        belief = imm.predicted(belief, dt_s, models=MODELS)
        seen = imm.innovation(belief, np.array([place]), noise=noise, models=MODELS)
        belief = imm.corrected(belief, seen, models=MODELS)
        assert np.isfinite(belief.state).all() and (belief.weight > 0).all()
        for covariance in belief.covariance:
            size = np.sqrt(np.diag(covariance))
            assert np.linalg.eigvalsh(covariance / np.outer(size, size)).min() > -1e-9
        assert belief.weight.sum() == pytest.approx(1.0)


def test_a_still_head_is_believed_calm_and_a_hasty_one_hasty() -> None:
    random, dt_s, noise = np.random.default_rng(2), 1 / 60, np.eye(3) * 0.002**2

    def weights(path: Any) -> Any:
        belief = imm.started(path[:1], noise=noise, speeds=(0.3,), models=MODELS)
        for place in path[1:] + random.normal(0, 0.002, path[1:].shape):
            belief = imm.predicted(belief, dt_s, models=MODELS)
            seen = imm.innovation(belief, place[None], noise=noise, models=MODELS)
            belief = imm.corrected(belief, seen, models=MODELS)
        return belief.weight

    times = np.arange(120) * dt_s
    assert np.argmax(weights(np.zeros((120, 3)))) == 0
    assert np.argmax(weights(np.stack([0.15 * np.sin(8 * times), 0 * times, 0 * times], 1))) == 2
