"""The tracker answers where the eyes are at any instant, says how it knows, and is fooled by little."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.config import TrackerSettings
from runtime.eyes.motions import observe, true_eyes
from runtime.eyes.tracker import Tracker
from runtime.records import EyePoints

MS = 1_000_000
PERIOD = 33_333_333
STILL = np.array([[0.6, -0.031, 0.03], [0.6, 0.031, 0.03]])
SURE = np.ones(2)
HOLD_MS = round(1000 * TrackerSettings().hold_s)


def points(
    eyes: NDArray[np.float64] | list[list[float]] = STILL, *, confidence: float = 1.0, completed: str = ""
) -> EyePoints:
    return EyePoints(np.asarray(eyes, dtype=float), SURE * confidence, completed)


def moving(k: float, speed: tuple[float, float, float] = (0.0, 0.3, 0.0)) -> NDArray[np.float64]:
    return STILL + np.array(speed) * (k * PERIOD / 1e9)


def fed(
    count: int = 30, motion: Callable[..., Any] = lambda k: STILL, settings: TrackerSettings | None = None
) -> tuple[Tracker, int]:
    tracker = Tracker(settings)
    for k in range(count):
        tracker.update(points(motion(k)), capture_ns=10**9 + k * PERIOD)
    return tracker, 10**9 + (count - 1) * PERIOD


# --- what an answer is called


def test_before_the_first_sample_nobody_is_there() -> None:
    answer = Tracker().at(123)
    assert (answer.label, answer.eyes_m, answer.capture_ns, answer.time_ns) == ("none", None, 0, 123)


def test_at_a_sample_the_answer_is_exact_between_two_interpolated_and_after_the_last_predicted() -> None:
    tracker, last = fed(motion=moving)
    exact, between, after = tracker.at(last - PERIOD), tracker.at(last - PERIOD // 2), tracker.at(last + 60 * MS)
    assert (exact.label, between.label, after.label) == ("exact", "interpolated", "predicted")
    assert exact.age_ns == 0 and after.age_ns == 60 * MS and after.capture_ns == last
    middle = (tracker.at(last - PERIOD).eyes_m + tracker.at(last).eyes_m) / 2
    np.testing.assert_allclose(between.eyes_m, middle, atol=1e-6)


def test_a_prediction_goes_on_with_the_heads_motion() -> None:
    tracker, last = fed(count=60, motion=moving)
    for ahead in (30, 60, 90):
        np.testing.assert_allclose(tracker.at(last + ahead * MS).eyes_m, moving(59 + ahead * MS / PERIOD), atol=1e-3)


def test_it_never_predicts_further_than_the_horizon() -> None:
    tracker, last = fed(count=60, motion=moving)
    limit = tracker.at(last + 120 * MS).eyes_m
    np.testing.assert_array_equal(tracker.at(last + 180 * MS).eyes_m, limit)


def test_a_lost_face_is_held_coming_to_rest_then_nobody() -> None:
    tracker, last = fed(count=60, motion=moving)
    tracker.update(None, capture_ns=last + PERIOD)
    path = [tracker.at(last + PERIOD + ms * MS) for ms in range(0, HOLD_MS - 40, 10)]
    assert {a.label for a in path} == {"held"}
    y = np.array([a.eyes_m[0, 1] for a in path])
    steps = np.diff(y)
    assert (steps >= -1e-12).all() and steps[0] > 3 * steps[7] and steps[-1] < 1e-6
    assert tracker.at(last + (HOLD_MS + 1) * MS).label == "none"


def test_a_stalled_stream_is_held_even_without_word_of_a_loss() -> None:
    tracker, last = fed()
    assert tracker.at(last + 190 * MS).label == "predicted"
    assert tracker.at(last + 210 * MS).label == "held"
    assert tracker.at(last + (HOLD_MS + 10) * MS).label == "none"


@given(ms=st.integers(-2000, 2000))
def test_every_answer_is_for_the_instant_asked_and_eyes_are_there_unless_none(ms: int) -> None:
    tracker, last = fed()
    answer = tracker.at(last + ms * MS)
    assert answer.time_ns == last + ms * MS
    assert (answer.eyes_m is None) == (answer.label == "none")
    if answer.label != "none":
        assert answer.age_ns == answer.time_ns - answer.capture_ns


# --- what it does not believe


@pytest.mark.parametrize(
    "bad",
    [
        points(STILL * np.nan),
        points([[0.6, np.inf, 0], [0.6, 0.03, 0]]),
        points(STILL + np.array([[0, 0, 0], [0, 0.03, 0]])),  # 92 mm apart
        points([[0.6, -0.01, 0.03], [0.6, 0.01, 0.03]]),  # 20 mm apart
        points(STILL + np.array([0.2, 0, 0])),  # 20 cm away at once
        points(confidence=0.1),
        points(confidence=np.nan),
        points([[1e200, -0.031, 0.03], [1e200, 0.031, 0.03]]),
    ],
    ids=["nan", "infinite", "too wide", "too narrow", "too far", "a blink", "no confidence", "absurd"],
)
def test_a_single_bad_sample_changes_nothing(bad: EyePoints) -> None:
    tracker, last = fed()
    before = tracker.at(last + 80 * MS)
    tracker.update(bad, capture_ns=last + PERIOD)
    after = tracker.at(last + 80 * MS)
    assert after.label == "predicted"
    np.testing.assert_array_equal(after.eyes_m, before.eyes_m)


def test_what_is_twice_elsewhere_is_believed() -> None:
    tracker, last = fed()
    there = STILL + np.array([0.2, 0.1, 0.0])
    for k in (1, 2):
        tracker.update(points(there), capture_ns=last + k * PERIOD)
    np.testing.assert_allclose(tracker.at(last + 2 * PERIOD + 70 * MS).eyes_m, there, atol=0.003)


def test_duplicates_and_late_samples_are_passed_over() -> None:
    tracker, last = fed()
    before = tracker.at(last + 50 * MS).eyes_m
    for capture_ns in (last, last - PERIOD, last - 900 * MS):
        tracker.update(points(STILL + 0.01), capture_ns=capture_ns)
    np.testing.assert_array_equal(tracker.at(last + 50 * MS).eyes_m, before)


def test_a_clock_that_was_set_back_begins_anew() -> None:
    tracker, last = fed()
    tracker.update(points(), capture_ns=last - 5 * 10**9)
    assert tracker.at(last - 5 * 10**9).label == "exact"


def test_an_unbroken_stream_of_nonsense_ends_in_nobody_not_in_nonsense() -> None:
    tracker, last = fed()
    for k in range(1, 60):
        tracker.update(points(STILL * np.nan), capture_ns=last + k * PERIOD)
    assert tracker.at(last + 60 * PERIOD).label == "none"


# --- loss and return


@pytest.mark.parametrize("lost_s", [0.15, 0.3, 0.4])
def test_eyes_that_return_are_followed_within_two_samples_and_without_a_jump(lost_s: float) -> None:
    tracker, last = fed()
    ahead = 60 * MS
    back_ns = last + round(lost_s * 1e9)
    elsewhere = STILL + np.array([0.0, 0.08, 0.0])
    shown = []
    for ns in range(last + PERIOD, back_ns + 8 * PERIOD, PERIOD // 3):
        if ns < back_ns:
            tracker.update(None, capture_ns=ns)
        else:
            k = (ns - back_ns) // PERIOD
            tracker.update(points(elsewhere), capture_ns=back_ns + k * PERIOD)
        shown.append((ns, tracker.at(ns + ahead)))
    y = np.array([a.eyes_m[0, 1] for _, a in shown])
    assert np.abs(np.diff(y)).max() < 0.045  # of 80 mm: no frame shows more than about half of the way at once
    arrived = next(ns for ns, a in shown if abs(a.eyes_m[0, 1] - elsewhere[0, 1]) < 0.004)
    assert arrived - back_ns <= 2 * PERIOD + PERIOD // 3


def test_after_nobody_the_first_sample_counts_at_once() -> None:
    tracker, last = fed()
    tracker.update(None, capture_ns=last + PERIOD)
    back = last + 3 * 10**9
    assert tracker.at(back).label == "none"
    tracker.update(points(STILL + 0.2), capture_ns=back)
    answer = tracker.at(back + 60 * MS)
    assert answer.label == "predicted"
    np.testing.assert_allclose(answer.eyes_m, STILL + 0.2, atol=1e-9)


# --- the head's pose


def test_a_turning_and_tilting_head_is_followed_without_refusing_samples() -> None:
    def turned(k: float) -> NDArray[np.float64]:
        t = k * PERIOD / 1e9
        yaw, roll = np.radians(50) * np.sin(4 * t), np.radians(20) * np.sin(3 * t)
        half = 0.031 * np.array([-np.sin(yaw), np.cos(yaw) * np.cos(roll), np.sin(roll)])
        half *= 0.031 / np.linalg.norm(half)
        return np.array([STILL.mean(0) - half, STILL.mean(0) + half])

    tracker, last = fed(count=120, motion=turned)
    assert tracker.outliers == 0
    assert np.linalg.norm(tracker.at(last + 60 * MS).eyes_m - turned(119 + 60 * MS / PERIOD), axis=1).max() < 0.012


def test_an_eye_that_was_filled_in_pulls_less() -> None:
    def pull(completed: str) -> np.float64:
        tracker, last = fed()
        tracker.update(points(STILL + np.array([0.004, 0, 0]), completed=completed), capture_ns=last + PERIOD)
        return tracker.at(last + PERIOD).eyes_m[0, 0] - 0.6

    assert 0 < pull("left") < 0.6 * pull("")


# --- properties


def test_it_is_deterministic() -> None:
    runs = []
    for _ in range(2):
        tracker = Tracker()
        for o in observe("walk", seconds=5, rate_hz=30):
            tracker.update(o.points, capture_ns=o.capture_ns)
            runs.append(tracker.at(o.capture_ns + 60 * MS).eyes_m)
    half = len(runs) // 2
    assert all(np.array_equal(a, b) for a, b in zip(runs[:half], runs[half:]) if a is not None)


def test_it_turns_and_shifts_with_the_frame() -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    shift = np.array([0.1, -0.2, 0.3])
    here, there = Tracker(), Tracker()
    for o in observe("lean", seconds=4, rate_hz=30, outliers=0.05):
        there.update(o.points and points(o.points.eyes_m @ turn.T + shift), capture_ns=o.capture_ns)
        here.update(o.points, capture_ns=o.capture_ns)
        one, other = here.at(o.capture_ns + 50 * MS).eyes_m, there.at(o.capture_ns + 50 * MS).eyes_m
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_allclose(one @ turn.T + shift, other, atol=1e-9)


def test_five_percent_outliers_hardly_move_it() -> None:
    def p95(outliers: Any) -> Any:
        tracker, errors = Tracker(), []
        for o in observe("lean", seconds=20, rate_hz=60, outliers=outliers, dropout_every_s=0):
            tracker.update(o.points, capture_ns=o.capture_ns)
            truth = true_eyes("lean", np.array([o.capture_ns / 1e9]))[0]
            errors.append(np.linalg.norm(tracker.at(o.capture_ns).eyes_m - truth, axis=1).max())
        return np.percentile(errors[30:], 95)

    assert p95(0.05) < 1.15 * p95(0.0)


def test_only_one_model_is_a_plain_kalman_filter_and_works() -> None:
    tracker, last = fed(count=60, motion=moving, settings=TrackerSettings(acceleration=(0.1,)))
    np.testing.assert_allclose(tracker.at(last).eyes_m, moving(59), atol=1e-3)


def test_every_refused_sample_is_counted() -> None:
    tracker, last = fed(motion=moving)
    for k in range(1, 4):
        tracker.update(points(STILL * 1.4), capture_ns=last + k * PERIOD)  # eyes 87 mm apart are no person's
    assert tracker.outliers == 3


@pytest.mark.parametrize("since_ms", [40, 60, 90, 119])
def test_lost_eyes_go_on_until_the_loss_and_then_come_to_rest_with_the_time_constant(since_ms: int) -> None:
    settings = TrackerSettings()
    tracker, last = fed(60, moving)
    speed = (tracker.at(last + 10 * MS).eyes_m - tracker.at(last).eyes_m) / 0.010
    tracker.update(None, capture_ns=last + PERIOD)
    held = tracker.at(last + since_ms * MS)
    known, rest = PERIOD / 1e9, settings.decay_s
    gone = known + rest * (1 - np.exp(-(since_ms / 1e3 - known) / rest))
    assert held.label == "held"
    np.testing.assert_allclose(held.eyes_m - tracker.at(last).eyes_m, speed * gone, atol=1e-9)
