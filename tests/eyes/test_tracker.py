"""Tests that the tracker gives the eyes at any time, with a label, and resists bad samples."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.config import TrackerSettings
from runtime.eyes.motions import true_eyes
from runtime.eyes.plausibility import NOT_NEWER
from runtime.eyes.tracker import ELSEWHERE, UNCERTAIN, Tracker, sideways_sigma_m
from runtime.records import EyePoints, EyesEstimate

MS = 1_000_000
PERIOD = 33_333_333
STILL = np.array([[0.6, -0.031, 0.03], [0.6, 0.031, 0.03]])
SURE = np.ones(2)
FINE_M2 = 1e-6 * np.eye(3)  # the covariance of the eyes' midpoint
HOLD_MS = round(1000 * TrackerSettings().hold_s)


def points(
    eyes: NDArray[np.float64] | list[list[float]] = STILL,
    *,
    confidence: float = 1.0,
    completed: str = "",
    covariance_m2: NDArray[np.float64] | None = None,
) -> EyePoints:
    return EyePoints(np.asarray(eyes, dtype=float), SURE * confidence, completed, covariance_m2)


def moving(k: float, speed: tuple[float, float, float] = (0.0, 0.3, 0.0)) -> NDArray[np.float64]:
    return STILL + np.array(speed) * (k * PERIOD / 1e9)


def aside(y_m: float, **how: Any) -> EyePoints:
    return points(STILL + np.array([0.0, y_m, 0.0]), **how)


def fed(
    count: int = 30, motion: Callable[..., Any] = lambda k: STILL, hold_s: float = 0.5, **noise: Any
) -> tuple[Tracker, int]:
    tracker = Tracker(TrackerSettings(hold_s=hold_s))
    for k in range(count):
        tracker.update(points(motion(k), **noise), capture_ns=10**9 + k * PERIOD)
    return tracker, 10**9 + (count - 1) * PERIOD


# --- labels


def test_answers_are_exact_at_samples_interpolated_between_and_predicted_after() -> None:
    tracker, last = fed(motion=moving)
    exact, between, after = tracker.at(last - PERIOD), tracker.at(last - PERIOD // 2), tracker.at(last + 60 * MS)
    assert (exact.label, between.label, after.label) == ("exact", "interpolated", "predicted")
    assert exact.capture_ns == exact.time_ns and after.capture_ns == last
    middle = (tracker.at(last - PERIOD).eyes_m + tracker.at(last).eyes_m) / 2
    np.testing.assert_allclose(between.eyes_m, middle, atol=1e-6)


def test_a_prediction_goes_on_with_the_heads_motion_up_to_the_horizon() -> None:
    tracker, last = fed(count=60, motion=moving)
    for ahead in (30, 60, 90):
        np.testing.assert_allclose(tracker.at(last + ahead * MS).eyes_m, moving(59 + ahead * MS / PERIOD), atol=1e-3)
    np.testing.assert_array_equal(tracker.at(last + 280 * MS).eyes_m, tracker.at(last + 200 * MS).eyes_m)


def test_a_lost_face_is_held_coming_to_rest_then_nobody() -> None:
    tracker, last = fed(count=60, motion=moving)
    tracker.update(None, capture_ns=last + PERIOD)
    path = [tracker.at(last + PERIOD + ms * MS) for ms in range(0, HOLD_MS - 40, 10)]
    assert {a.label for a in path} == {"held"}
    steps = np.diff([a.eyes_m[0, 1] for a in path])
    assert (steps >= -1e-12).all() and (np.diff(steps[5:]) <= 1e-12).all()
    assert steps[0] > 3 * steps[25] and steps[-1] < 1e-6
    assert tracker.at(last + (HOLD_MS + 1) * MS).label == "none"


def test_a_stalled_stream_is_held_even_without_word_of_a_loss() -> None:
    tracker, last = fed()
    after = {0: "exact", 1: "predicted", 200: "predicted", 201: "held", 500: "held", 501: "none"}
    assert [tracker.at(last + ms * MS).label for ms in after] == list(after.values())


def test_the_newest_256_samples_are_remembered() -> None:
    tracker, last = fed(300)
    assert tracker.at(last - 255 * PERIOD).label == "exact"
    assert tracker.at(last - 256 * PERIOD).label == tracker.at(last - 255 * PERIOD - 1).label == "none"


@given(ms=st.integers(-2000, 2000))
def test_every_answer_is_for_the_instant_asked_with_eyes_unless_none(ms: int) -> None:
    assert Tracker().at(ms) == EyesEstimate(ms, 0, None, "none")
    tracker, last = fed()
    answer = tracker.at(last + ms * MS)
    assert answer.time_ns == last + ms * MS
    assert (answer.eyes_m is None) == (answer.label == "none")


# --- rejected samples


def test_duplicates_and_late_samples_are_passed_over() -> None:
    tracker, last = fed()
    before = tracker.at(last + 50 * MS).eyes_m
    for capture_ns in (last, last - PERIOD, last - 900 * MS):
        tracker.update(points(STILL + 0.01), capture_ns=capture_ns)
    np.testing.assert_array_equal(tracker.at(last + 50 * MS).eyes_m, before)


@pytest.mark.parametrize(("back_ns", "why"), [(999_999_999, NOT_NEWER), *((s * 10**9, "") for s in (1, 2, 5))])
def test_a_clock_that_was_set_back_by_a_second_begins_anew(back_ns: int, why: str) -> None:
    tracker, last = fed(100)
    assert tracker.update(points(), capture_ns=last - back_ns) == why
    assert tracker.seen_ns == (last if why else last - back_ns)
    assert tracker.is_established == bool(why)
    assert why or tracker.at(last - back_ns).label == "exact"


@pytest.mark.parametrize(("bad", "why"), [
    (points([[0.6, np.inf, 0], [0.6, 0.03, 0]]), "not a number"), (points(np.add(STILL, [0.2, 0, 0])), ELSEWHERE),
    (points([[1e200, -0.031, 0.03], [1e200, 0.031, 0.03]]), "too far away for a viewer"),
    (points(confidence=0.29), UNCERTAIN), (points(confidence=np.nan), UNCERTAIN),
])  # fmt: skip
def test_a_single_bad_sample_changes_nothing_and_is_refused_with_its_reason(bad: EyePoints, why: str) -> None:
    tracker, last = fed()
    before = tracker.at(last + 80 * MS)
    assert tracker.update(bad, capture_ns=last + PERIOD) == why
    np.testing.assert_array_equal(tracker.at(last + 80 * MS).eyes_m, before.eyes_m)
    assert tracker.update(points(), capture_ns=last + PERIOD) == NOT_NEWER
    assert tracker.update(points(confidence=0.3), capture_ns=last + 2 * PERIOD) == ""


def test_a_hasty_head_is_followed_at_its_second_sample() -> None:
    tracker, last = fed()
    hasty, far = STILL + np.array([0.0, 0.017, 0.0]), STILL + np.array([0.0, 0.4, 0.0])
    told = [tracker.update(points(hasty), capture_ns=last + k * PERIOD) for k in (1, 2)]
    assert told[-1] == ""
    tracker, last = fed()
    told = [tracker.update(points(far), capture_ns=last + k * PERIOD) for k in range(1, 17)]
    assert told == [ELSEWHERE] * 15 + [""] and tracker.replaced == 1
    np.testing.assert_allclose(tracker.at(last + 16 * PERIOD + 20 * MS).eyes_m, far, atol=1e-9)  # and immediately


@pytest.mark.parametrize(
    ("gap_ms", "near_m", "far_m"), [(33.333, 0.030, 0.035), (100, 0.162, 0.170), (200, 0.412, 0.423)]
)
def test_a_viewer_s_second_sample_counts_within_reach(gap_ms: float, near_m: float, far_m: float) -> None:
    """At 30 m/s² up to 2 m/s, and with the noise."""
    for y_m, second in ((near_m, ""), (far_m, ELSEWHERE)):
        tracker, last = fed(covariance_m2=FINE_M2)
        begin = last + round(gap_ms * MS)
        told = [tracker.update(aside(y_m, covariance_m2=FINE_M2), capture_ns=begin + k * PERIOD) for k in (0, 1)]
        assert told == [ELSEWHERE, second] and tracker.replaced == 0


@pytest.mark.parametrize(("hold_s", "after_ms"), [(0.2, 200), (1.0, 500)])
def test_another_person_is_followed_after_half_a_second_or_the_hold(hold_s: float, after_ms: int) -> None:
    for ms, why in ((after_ms, ELSEWHERE), (after_ms + 1, "")):
        tracker, last = fed(hold_s=hold_s)
        assert tracker.update(aside(3.0), capture_ns=last + ms * MS) == why
        assert tracker.replaced == (why == "") and tracker.is_established == bool(why)
        assert tracker.seen_ns == (last if why else last + ms * MS)


@pytest.mark.parametrize(("y_m", "seen_first", "why"), [(0.24, False, ""), (0.24, True, ELSEWHERE), (0.2, True, "")])
def test_a_doubtful_sample_that_another_person_fits_better_is_theirs(y_m: float, seen_first: bool, why: str) -> None:
    tracker, last = fed(covariance_m2=FINE_M2)
    if seen_first:  # too soon for the viewer to have gone there
        assert tracker.update(aside(0.29, covariance_m2=FINE_M2), capture_ns=last + 10 * MS) == ELSEWHERE
    assert tracker.update(aside(y_m, covariance_m2=FINE_M2), capture_ns=last + 350 * MS) == why


@pytest.mark.parametrize(("y_m", "third"), [(0.20, ""), (0.162, ""), (0.155, ELSEWHERE)])
def test_a_doubtful_sample_is_undone_by_the_next_two(y_m: float, third: str) -> None:
    tracker, last = fed(covariance_m2=FINE_M2)
    back = last + 300 * MS
    path = ((0, y_m), (1, 0.0), (2, 0.0))
    told = [tracker.update(aside(y, covariance_m2=FINE_M2), capture_ns=back + k * PERIOD) for k, y in path]
    assert told == ["", ELSEWHERE, third]
    assert tracker.at(back).label == ("exact" if third else "interpolated")  # its sample is gone
    if not third:
        np.testing.assert_allclose(tracker.at(back + 2 * PERIOD + 100 * MS).eyes_m, STILL, atol=1e-6)


def test_a_head_is_established_with_its_third_sample() -> None:
    tracker = Tracker()
    assert tracker.seen_ns is None and not tracker.is_established
    for ms, is_established in ((100, False), (133, False), (166, True)):
        tracker.update(points(), capture_ns=ms * MS)
        assert tracker.seen_ns == ms * MS and tracker.is_established is is_established


@pytest.mark.parametrize(("samples", "age_ms", "y_m", "reach_m"), [
    *((30, age_ms, 0.005, None) for age_ms in (-100, 0, 251)),
    *((30, age_ms, 0.005, reach_m) for age_ms, reach_m in ((10, 0.0166), (100, 0.0661), (200, 0.2161), (250, 0.3286))),
    *((2, age_ms, 0.005, reach_m) for age_ms, reach_m in ((0, None), (10, 0.0370), (100, 0.2170), (250, 0.5170))),
    (2, 250, 0.1, 0.5170), (2, 250, 0.3, None),
])  # fmt: skip
def test_people_are_recognised_within_their_reach(samples: int, age_ms: int, y_m: float, reach_m: float | None) -> None:
    """At 10 m/s² once established, else at 2 m/s, and with the noise; for a quarter of a second, if they go on so."""
    tracker, last = fed(samples, covariance_m2=FINE_M2)
    found = tracker.reach_m(aside(y_m, covariance_m2=FINE_M2), capture_ns=last + age_ms * MS)
    assert (found is None) == (reach_m is None)
    np.testing.assert_allclose([*(found or ())], [] if reach_m is None else [y_m, reach_m], atol=2e-4)
    assert Tracker().reach_m(points(), capture_ns=last) is None


@given(
    offset_m=st.tuples(*[st.floats(-0.1, 0.1)] * 3).filter(lambda off: np.linalg.norm(off) > 0.04),
    seed=st.integers(0, 1000),
)
def test_a_mistaken_first_sample_is_dropped_without_leaving_any_speed(
    offset_m: tuple[float, float, float], seed: int
) -> None:
    """Else the wrong place is taken for the start of a fast movement, and eyes are predicted to fly on."""
    noise_m = np.random.default_rng(seed).normal(0.0, 3e-4, (4, 2, 3))
    tracker = Tracker()
    tracker.update(points(STILL + np.array(offset_m)), capture_ns=10**9)
    for k in (1, 2, 3):
        tracker.update(points(STILL + noise_m[k]), capture_ns=10**9 + k * PERIOD)
    at = [tracker.ahead(10**9 + 3 * PERIOD + ms * MS).eyes_m for ms in (0, 125)]
    np.testing.assert_allclose(at, [STILL, STILL], atol=0.005)


# --- uncertainty


def test_a_head_that_jumps_about_is_no_error() -> None:
    """The first sample of a head may be a surprise, with none before it to go back to."""
    tracker = Tracker()
    for ms, y_m in ((200, 0.302), (233, 0.2), (298, 0.203), (314, 0.3), (330, 0.1)):
        tracker.update(points(np.add(STILL, [0.0, y_m, 0.0]), covariance_m2=4e-8 * np.eye(3)), capture_ns=ms * MS)
    eyes_m = tracker.at(330 * MS).eyes_m
    assert eyes_m is not None and np.isfinite(eyes_m).all()


def drawn(covariance_m2: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors (n, 3) of the middle 45 ms ahead, and reported sigma (n,), of a leaning head with this noise."""
    random, tracker, off, told = np.random.default_rng(2), Tracker(), [], []
    for k in range(600):
        time_s = k * PERIOD / 1e9
        eyes = true_eyes("lean", np.array([time_s, 30.0]))[0] + random.multivariate_normal(np.zeros(3), covariance_m2)
        assert tracker.update(points(eyes, covariance_m2=covariance_m2), capture_ns=k * PERIOD) == "" or k < 3
        answer = tracker.at(k * PERIOD + 45 * MS)
        off.append((answer.eyes_m - true_eyes("lean", np.array([time_s + 0.045, 30.0]))[0]).mean(0))
        told.append(answer.sigma_m)
    return np.array(off)[60:], np.array(told)[60:]


def test_each_axis_is_weighted_by_its_own_noise() -> None:
    fine = np.diag([0.002, 0.0001, 0.0001]) ** 2
    off, told = drawn(fine)
    coarse, _ = drawn(np.eye(3) * 0.002**2)
    assert np.sqrt((off[:, 1:] ** 2).mean()) < 0.35 * np.sqrt((coarse[:, 1:] ** 2).mean())
    eye_m = np.array([0.6, 0.0, 0.0])
    true = sideways_sigma_m(off.T @ off / len(off), eye_m, panel_m=(0.5184, 0.2916))
    assert 0.5 * true < np.sqrt((told**2).mean()) < 2.0 * true


@pytest.mark.parametrize("covariance_m2", [np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3)])
def test_a_covariance_that_is_none_breaks_nothing(covariance_m2: NDArray[np.float64]) -> None:
    tracker, last = fed(covariance_m2=covariance_m2)
    np.testing.assert_allclose(tracker.at(last + 50 * MS).eyes_m, STILL, atol=1e-6)


@pytest.mark.parametrize(("told", "used"), [
    (np.diag([1e-6, 3.9e-10, 1e-6]), np.diag([1e-6, 4e-10, 1e-6])),
    (np.diag([4e-6, 2e-6, 1e-6]) + np.eye(3)[[1, 0, 2]] * [3e-6, 3e-6, 0], None),
    (np.full((3, 3), -1e-6) + np.diag([2.5e-6, 2.5e-6, 2.5e-6]), None),
    (np.eye(3) * 1e-6 + np.diag([8e-7, 0], 1), np.eye(3) * 1e-6 + np.diag([4e-7, 0], 1) + np.diag([4e-7, 0], -1)),
])  # fmt: skip
def test_a_driver_s_noise_is_raised_to_20_micrometres_in_every_direction(
    told: NDArray[np.float64], used: NDArray[np.float64] | None
) -> None:
    if used is None:
        variances, axes = np.linalg.eigh(told)
        used = axes @ np.diag(np.maximum(variances, 4e-10)) @ axes.T
    path = [np.multiply([0.002, -0.003, 0.001], np.sin([k, 2 * k, 3 * k])) for k in range(12)]
    answers = []
    for covariance_m2 in (told, used):
        tracker, last = fed(12, lambda k: STILL + path[k], covariance_m2=covariance_m2)
        answers.append(tracker.at(last + 50 * MS))
    np.testing.assert_allclose(answers[0].eyes_m, answers[1].eyes_m, rtol=0, atol=1e-9)
    assert answers[0].sigma_m == pytest.approx(answers[1].sigma_m, rel=1e-6)


def test_noise_is_measured_where_the_driver_reports_none() -> None:
    sigmas = [tracker.at(last).sigma_m for tracker, last in (fed(15), fed(25), fed(60, covariance_m2=5e-9 * np.eye(3)))]
    assert sigmas[1] < 0.3 * sigmas[0] and sigmas[2] < 0.3 * sigmas[0]
    wild, last = fed(15)
    for k in range(1, 15):  # of samples that are accepted
        assert wild.update(aside(0.3 + 0.01 * k), capture_ns=last + k * PERIOD // 8) == ELSEWHERE
    assert wild.at(last).sigma_m == sigmas[0]


def test_one_sample_s_sigma_is_its_own_noise_and_an_unknown_speed() -> None:
    """An eye has twice the midpoint's variance, and a new head moves at 0.3 m/s or turns at a third of that."""
    tracker, last = fed(1, covariance_m2=FINE_M2)
    told = [tracker.at(last + ms * MS).sigma_m for ms in (0, 33, 66)]
    np.testing.assert_allclose(told, [0.001444, 0.01077, 0.02151], rtol=2e-3)


def test_sigma_grows_while_the_head_is_not_seen() -> None:
    tracker, last = fed(count=60, motion=moving)
    sigmas = [tracker.at(last + ms * MS).sigma_m for ms in (10, 60, 120, 250, 400)]
    assert sigmas == sorted(sigmas) and sigmas[-1] > 0.02  # it may have turned round, at 0.3 m/s


def test_depth_counts_by_its_lever() -> None:
    depth = np.diag([0.001**2, 0.0, 0.0])
    eye_m = np.array([0.75, 0.0, 0.0])
    random = np.random.default_rng(0)
    foot = np.stack([random.uniform(-0.5184, 0.5184, 100_000), random.uniform(-0.2916, 0.2916, 100_000)], 1) / 2
    expected = np.sqrt(((foot / 0.75 * 0.001) ** 2).mean())
    assert sideways_sigma_m(depth, eye_m, panel_m=(0.5184, 0.2916)) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("eye_m", [(0.6, 0.3, 0.2), (0.6, -0.3, 0.1), (0.5, 0.0, -0.4)])
def test_an_error_along_the_line_of_sight_counts_as_depth(eye_m: tuple[float, float, float]) -> None:
    """The display's centre does not see it, wherever the eye is, and its other points see the depth."""
    along_m = 0.001 * np.array(eye_m) / eye_m[0]
    on_axis = sideways_sigma_m(np.diag([1e-6, 0, 0]), np.array([eye_m[0], 0, 0]), panel_m=(0.5, 0.3))
    told = sideways_sigma_m(np.outer(along_m, along_m), np.array(eye_m), panel_m=(0.5, 0.3))
    assert told == pytest.approx(on_axis) == pytest.approx(1e-3 * np.sqrt((0.25 + 0.09) / 24) / eye_m[0])


@pytest.mark.parametrize(("error_m2", "eye_m", "expected_m"), [
    (np.diag([0, 4e-6, 0]), (0.6, 0.3, 0.2), 0.001414), (np.diag([0, 0, 4e-6]), (0.6, 0.3, 0.2), 0.001414),
    (np.diag([0, 4e-6, 4e-6]), (3.0, 0, 0), 0.002), (np.diag([1e-6, 0, 0]), (0.6, 0.3, 0.2), 0.000469),
    (np.diag([1e-6, 0, 0]), (0.1, 0, 0), 0.00119), (np.diag([1e-6, 0, 0]), (0.05, 0, 0), 0.00119),
    (-np.eye(3), (0.6, 0, 0), 0.0),
])  # fmt: skip
def test_sideways_errors_count_fully_per_axis(
    error_m2: NDArray[np.float64], eye_m: tuple[float, float, float], expected_m: float
) -> None:
    told = sideways_sigma_m(error_m2, np.array(eye_m), panel_m=(0.5, 0.3))
    assert told == pytest.approx(expected_m, rel=2e-3)


# --- loss and return


@pytest.mark.parametrize(("gap_ms", "goes_on_m"), [(400, 0.03), (401, 0.0)])
def test_a_motion_is_known_for_400_ms(gap_ms: int, goes_on_m: float) -> None:
    tracker, last = fed(60, moving, covariance_m2=FINE_M2)
    tracker.update(None, capture_ns=last + PERIOD)
    again = moving(59 + gap_ms * MS / PERIOD)
    assert tracker.update(points(again, covariance_m2=FINE_M2), capture_ns=last + gap_ms * MS) == ""
    assert tracker.at(last + (gap_ms + 100) * MS).eyes_m[0, 1] - again[0, 1] == pytest.approx(goes_on_m, abs=2e-4)


@pytest.mark.parametrize("ahead_ms", [0, 20])
def test_found_eyes_blend_within_60_ms_of_what_was_shown(ahead_ms: int) -> None:
    """From the latest time shown on; what was only looked up, without a picture, does not count."""
    tracker, last = fed(covariance_m2=FINE_M2)
    tracker.update(None, capture_ns=last + PERIOD)
    back = last + 150 * MS
    tracker.at(back + ahead_ms * MS)
    tracker.ahead(back + 50 * MS)
    assert tracker.update(aside(0.08, covariance_m2=FINE_M2), capture_ns=back) == ""
    shown = [tracker.at(back + (ahead_ms + ms) * MS) for ms in (0, 15, 30, 45, 60, 100)]
    assert {answer.label for answer in shown[1:]} == {"predicted"}
    off_m = [answer.eyes_m[1, 1] - STILL[1, 1] for answer in shown]
    np.testing.assert_allclose(off_m, [0.0, 0.0125, 0.04, 0.0675, 0.08, 0.08], atol=1e-6)


@pytest.mark.parametrize(("lost_ms", "back_ms", "jumps"), [(33, 100, False), (None, 250, False), (None, 150, True)])
def test_eyes_that_were_held_blend_where_they_are_expected_too(lost_ms: int | None, back_ms: int, jumps: bool) -> None:
    tracker, last = fed(covariance_m2=FINE_M2)
    if lost_ms is not None:
        tracker.update(None, capture_ns=last + lost_ms * MS)
    before = tracker.at(last + (back_ms + 10) * MS).eyes_m
    assert tracker.update(aside(0.01, covariance_m2=FINE_M2), capture_ns=last + back_ms * MS) == ""
    after = [tracker.at(last + (back_ms + ms) * MS).eyes_m for ms in (10, 70)]
    assert (np.abs(after[0] - before).max() > 0.005) == jumps and np.abs(after[1] - before).max() > 0.005
    assert jumps or np.abs(after[0] - before).max() < 1e-12


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
    assert np.abs(np.diff(y)).max() < 0.05  # of 80 mm: no frame shows much more than half of the way
    arrived = next(ns for ns, a in shown if abs(a.eyes_m[0, 1] - elsewhere[0, 1]) < 0.015)
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

    tracker, last = Tracker(), 10**9 + 119 * PERIOD
    assert not any([tracker.update(points(turned(k)), capture_ns=10**9 + k * PERIOD) for k in range(120)])
    assert np.linalg.norm(tracker.at(last + 60 * MS).eyes_m - turned(119 + 60 * MS / PERIOD), axis=1).max() < 0.012


def test_an_eye_that_was_filled_in_pulls_less() -> None:
    def pull(completed: str) -> np.float64:
        tracker, last = fed(10)  # too few samples to measure the noise
        tracker.update(points(STILL + np.array([0.004, 0, 0]), completed=completed), capture_ns=last + PERIOD)
        return tracker.at(last + PERIOD).eyes_m[0, 0] - 0.6

    assert 0 < pull("left") == pytest.approx(0.408 * pull(""), rel=0.02)


@pytest.mark.parametrize(
    ("lost_ms", "ms"), [*product([33], [40, 60, 90, 119]), *product([300], [300, 350, 390, 400, 410, 2000])]
)
def test_lost_eyes_come_to_rest_within_400_ms_of_their_sample(lost_ms: int, ms: int) -> None:
    tracker, last = fed(60, moving, hold_s=2.0)
    for told_ms in (lost_ms, lost_ms + 50):  # the first word of a loss counts
        tracker.update(None, capture_ns=last + told_ms * MS)
    held, rest = tracker.at(last + ms * MS), tracker.at(last + 400 * MS)
    gone_ms = lost_ms + 200 * (1 - np.exp(-(min(ms, 400) - lost_ms) / 200))
    assert held.label == "held" and (np.array_equal(held.eyes_m, rest.eyes_m) == (ms >= 400))
    assert ms >= 400 or (held.eyes_m[:, 1] < rest.eyes_m[:, 1]).all()
    np.testing.assert_allclose(held.eyes_m, moving(59 + gone_ms * MS / PERIOD), atol=1e-3)
