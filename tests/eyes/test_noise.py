"""Tests that the noise of a sensor is measured, whatever the head does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.eyes import motions
from runtime.eyes.noise import NoiseWatch
from runtime.eyes.tracker import HEAD_FROM_EYES


def measured(motion: str, sigma_m: tuple[float, float, float], *, rate_hz: float = 30.0, seed: int = 1) -> np.ndarray:
    """The noise found after ten seconds of a motion, with jitter and gaps between the samples."""
    random = np.random.default_rng(seed)
    times_s = np.arange(0.0, 10.0, 1 / rate_hz)
    times_s = (times_s + random.uniform(-0.2, 0.2, len(times_s)) / rate_hz)[random.random(len(times_s)) > 0.05]
    eyes = motions.true_eyes(motion, times_s) + random.normal(0.0, sigma_m, (len(times_s), 2, 3))
    watch = NoiseWatch()
    for time_s, pair in zip(times_s, eyes, strict=True):
        watch.add(HEAD_FROM_EYES @ pair, capture_ns=round(time_s * 1e9))
    assert watch.sigma_m is not None
    return watch.sigma_m


@pytest.mark.parametrize("rate_hz", [30.0, 60.0])
@pytest.mark.parametrize("motion", motions.MOTIONS)
def test_noise_is_measured_on_each_axis_during_every_motion(motion: str, rate_hz: float) -> None:
    sigma_m = 0.003, 0.0003, 0.001
    found = np.mean([measured(motion, sigma_m, rate_hz=rate_hz, seed=seed) for seed in range(4)], axis=0)
    np.testing.assert_allclose(found, sigma_m, rtol=0.5)  # the larger of two medians of overlapping windows
    assert (found > 0.9 * np.array(sigma_m)).all()
    assert measured(motion, (0.0, 0.0, 0.0), rate_hz=rate_hz).max() < 4e-4  # motion alone is hardly any noise


@pytest.mark.parametrize(("count", "period_ms", "is_known"), [
    (19, 30, False), (20, 30, True), (100, 99, True), (100, 101, False), (100, 200, False), (100, -30, False),
])  # fmt: skip
def test_noise_is_known_from_twenty_samples_without_gaps(count: int, period_ms: int, is_known: bool) -> None:
    watch = NoiseWatch()
    for k in range(count):
        watch.add(np.zeros((2, 3)), capture_ns=10**10 + k * period_ms * 1_000_000)
    assert (watch.sigma_m is not None) == is_known


def test_noise_of_the_newest_64_differences_is_renewed_with_every_fourth() -> None:
    watch, random, told_m = NoiseWatch(), np.random.default_rng(0), []
    for k in range(144):
        watch.add(random.normal(0.0, 0.001, (2, 3)) if k < 100 else np.zeros((2, 3)), capture_ns=k * 30_000_000)
        told_m.append(None if watch.sigma_m is None else float(watch.sigma_m.max()))
    changes = [k for k in range(1, 120) if told_m[k] != told_m[k - 1]]
    assert changes[0] == 19 and len(changes) > 12 and {k % 4 for k in changes} == {3}
    assert (told_m[131] or 0.0) > 2e-4 and told_m[143] == 1e-4


@given(scale=st.floats(1e-4, 1e-1), seed=st.integers(0, 10))
def test_measured_noise_is_proportional_to_actual_noise_and_has_a_floor(scale: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    samples = random.normal(0.0, 1.0, (74, 2, 3))
    watches = NoiseWatch(), NoiseWatch()
    for k, sample in enumerate(samples):
        for watch, size in zip(watches, (scale, 1e-6), strict=True):
            watch.add(size * sample, capture_ns=k * 20_000_000)
    assert watches[0].sigma_m is not None and watches[1].sigma_m is not None
    assert ((0.8 * scale < watches[0].sigma_m) & (watches[0].sigma_m < 2.5 * scale)).all()
    assert watches[1].sigma_m.tolist() == [1e-4] * 3
