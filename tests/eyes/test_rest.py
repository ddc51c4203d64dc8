"""Tests that a resting head is distinguished from a moving one at any sensor noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clock import NS_PER_S
from runtime.eyes.rest import RestWatch

EYES = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])
MOST_M = 0.001


def watched(
    seconds: float,
    *,
    noise_m: float,
    aside_m: Callable[[float], float] = lambda _: 0.0,
    rate_hz: float = 30.0,
    seed: int = 0,
    outliers: float = 0.0,
) -> list[tuple[float, np.ndarray, np.ndarray | None]]:
    """(time, true eyes, place) after each sample of a head that moves sideways as given."""
    random = np.random.default_rng(seed)
    watch = RestWatch(max_drift_m=MOST_M)
    told = []
    for number in range(int(seconds * rate_hz)):
        time_s = number / rate_hz
        true = EYES + np.array([0.0, aside_m(time_s), 0.0])
        sample = true + random.normal(0.0, noise_m, (2, 3))
        if random.random() < outliers:
            sample = true + random.uniform(-0.3, 0.3, 3)
        watch.update(sample, capture_ns=NS_PER_S + int(time_s * NS_PER_S))
        told.append((time_s, true, watch.place))
    return told


@pytest.mark.parametrize("noise_mm", [0.0, 0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize(("rate_hz", "seed"), [(30, 0), (30, 1), (60, 2), (3, 3)])
def test_a_still_head_is_found_at_rest_once_near_its_place(noise_mm: float, rate_hz: float, seed: int) -> None:
    told = watched(60, noise_m=noise_mm / 1000, rate_hz=rate_hz, seed=seed)
    rests_from_s = 1.1 if rate_hz > 8 else 3.0
    places = [place for time_s, _, place in told if time_s > rests_from_s]
    assert all(place is places[0] for place in places)
    assert places[0] is not None
    assert np.abs(places[0] - EYES)[:, 1:].max() <= 1e-12 + noise_mm / 1000  # of a single sample; a frame errs more


def test_outliers_are_not_motion() -> None:
    told = watched(60, noise_m=0.001, outliers=0.05)
    assert np.mean([place is None for time_s, _, place in told if time_s > 2.0]) < 0.15


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("noise_mm", [0.2, 1.0, 2.0])
def test_a_head_that_sets_off_is_let_go_before_it_is_far(noise_mm: float, speed: float) -> None:
    for seed in range(8):
        told = watched(5, noise_m=noise_mm / 1000, aside_m=lambda s: speed * float(np.clip(s - 3, 0, 1)), seed=seed)
        behind = [abs(place[0, 1] - true[0, 1]) for time_s, true, place in told if place is not None and 3 < time_s < 4]
        # Two samples' way, and what noise hides of it.
        assert max(behind, default=0.0) < 2.1 * speed / 30 + 0.0015 + 4.5 * noise_mm / 1000


@pytest.mark.parametrize("noise_mm", [0.0, 1.0])
def test_a_head_in_motion_never_rests_and_slow_drift_is_bounded(noise_mm: float) -> None:
    told = watched(10, noise_m=noise_mm / 1000, aside_m=lambda s: 0.1 * float(np.sin(2 * s)))
    assert np.mean([place is None for _, _, place in told]) > 0.9
    told = watched(60, noise_m=noise_mm / 1000, aside_m=lambda s: 0.0005 * s)  # 3 cm in all
    off = [abs(place[0, 1] - true[0, 1]) for _, true, place in told if place is not None]
    assert max(off) < 2 * MOST_M + 3 * noise_mm / 1000


def rested(eyes: np.ndarray = EYES, *, count: int = 60, noise_m: float = 0.0) -> RestWatch:
    watch, random = RestWatch(max_drift_m=MOST_M), np.random.default_rng(0)
    for number in range(count):
        watch.update(eyes + random.normal(0.0, noise_m, (2, 3)), capture_ns=number * NS_PER_S // 30)
    assert watch.place is not None
    return watch


@pytest.mark.parametrize("rate_hz", [29, 30])
def test_a_head_comes_to_rest_at_the_median_of_the_last_second(rate_hz: int) -> None:
    samples, watch = EYES + np.random.default_rng(0).normal(0.0, 0.001, (90, 2, 3)), RestWatch(max_drift_m=MOST_M)
    newest = -1
    while watch.place is None:
        newest += 1
        watch.update(samples[newest], capture_ns=newest * NS_PER_S // rate_hz)
    np.testing.assert_allclose(watch.place, np.median(samples[newest - rate_hz : newest + 1], axis=0), atol=1e-15)


def test_a_shift_within_the_noise_is_followed_after_almost_two_seconds() -> None:
    told = watched(12, noise_m=0.002, aside_m=lambda s: 0.004 * (s >= 6), seed=16)
    changes = [number for number in range(60, 360) if told[number][2] is not told[number - 1][2]]
    assert len(changes) == 1 and 45 < changes[0] - 180 < 60


def test_noise_is_that_of_the_newest_128_samples() -> None:
    watch, random, told_m = RestWatch(max_drift_m=MOST_M), np.random.default_rng(0), []
    for number in range(240):
        noise_m = random.normal(0.0, 0.001, (2, 3)) if number < 160 else 0.0
        watch.update(EYES + noise_m, capture_ns=number * NS_PER_S // 30)
        told_m.append(watch.noise_m.max())
    assert told_m[223] > 5e-5 and told_m[231] < 1e-9  # once more than half of them have none


NEWEST_NS = 59 * NS_PER_S // 30


@pytest.mark.parametrize(("capture_ns", "rests"), [
    (NEWEST_NS + 1, True), (NEWEST_NS + NS_PER_S - 1, True), (NEWEST_NS + NS_PER_S, False), (NEWEST_NS, False),
    (NEWEST_NS - NS_PER_S, False),
])  # fmt: skip
def test_a_gap_or_a_clock_that_was_set_back_ends_rest(capture_ns: int, rests: bool) -> None:
    watch = rested()
    watch.update(EYES, capture_ns=capture_ns)
    assert (watch.place is not None) is rests
    for number in range(1, 31):
        watch.update(EYES, capture_ns=capture_ns + number * NS_PER_S // 30)
        assert (watch.place is not None) is (rests or number == 30)  # a second later


ASIDE = np.array([[0.6, 0.269, 0.2], [0.6, 0.331, 0.2]])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("eyes", "step_mm", "leaves"), [
    (EYES, (0.0, 0.29, 0.0), False), (EYES, (0.0, 0.31, 0.0), True), (EYES, (0.0, 0.0, 0.29), False),
    (EYES, (0.0, 0.0, 0.31), True), (EYES * [1, 1, 0], (1.15, 0.0, 0.0), False),
    (EYES * [1, 1, 0], (1.25, 0.0, 0.0), True), (EYES * [0.1, 1, 0], (0.25, 0.0, 0.0), True),
    (ASIDE, (1.0, 0.5, 0.333), False), (ASIDE, (1.0, 0.0, 0.333), True), (ASIDE, (1.0, 0.5, 0.0), True),
])  # fmt: skip
def test_a_head_has_left_at_its_second_sample_seen_elsewhere(
    eyes: np.ndarray, step_mm: tuple[float, float, float], leaves: bool, sign: float
) -> None:
    """Depth counts by a quarter, which is seen at the display's edges, and nothing is seen of a way to its centre."""
    watch, place = rested(eyes), eyes + sign * np.array(step_mm) / 1000
    rests = []
    for number in range(60, 95):
        watch.update(place, capture_ns=number * NS_PER_S // 30)
        rests.append(watch.place is not None)
    assert rests == ([True, *[False] * 29, *[True] * 5] if leaves else [True] * 35)


@pytest.mark.parametrize(("noise_mm", "noise_high_mm", "sigma_mm"), [(0, 0, 0.71), (1, 1.17, 1.44), (3, 3.5, 2.95)])
def test_sigma_covers_noise_and_the_drift_that_is_not_detected(
    noise_mm: float, noise_high_mm: float, sigma_mm: float
) -> None:
    watch = rested(noise_m=noise_mm / 1000)
    assert watch.sigma_m * 1000 == pytest.approx(sigma_mm, abs=0.02)
    np.testing.assert_allclose(watch.noise_m * 1000, [0.32 * noise_high_mm, *[noise_high_mm] * 2], rtol=0.05)


def test_a_head_that_leans_in_on_the_axis_is_seen_to_leave() -> None:
    watch = RestWatch(max_drift_m=MOST_M)
    for number in range(90):
        closer = np.array([0.2 * max(0.0, number / 30 - 2), 0.0, 0.0])
        watch.update(EYES * [1, 1, 0] - closer, capture_ns=number * NS_PER_S // 30)
        assert watch.place is None or closer[0] < 0.015


@pytest.mark.parametrize("noise_m", [0.006, 0.02])
def test_what_scatters_more_than_any_sensor_s_noise_never_rests(noise_m: float) -> None:
    assert all(place is None for _, _, place in watched(20, noise_m=noise_m))


@given(x_m=st.floats(-0.01, 0.01), y_m=st.floats(-0.001, 0.001))
def test_whatever_it_rested_at_it_can_be_left(x_m: float, y_m: float) -> None:
    watch = RestWatch(max_drift_m=MOST_M)
    for number in range(90):
        watch.update(np.tile([x_m, y_m, 0.0], (2, 1)), capture_ns=number * NS_PER_S // 30)
    for number in range(90, 93):
        watch.update(EYES, capture_ns=number * NS_PER_S // 30)
    assert watch.place is None
