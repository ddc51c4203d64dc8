"""Tests where two simulated people are, when, and which of them the simulated sensor sees."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.eyes.two_people import MOTIONS_OF_TWO, hidden, observe_two, true_eyes_of_two
from runtime.records import F64

Place = tuple[float, float, float]
LEFT, RIGHT, AWAY = (0.62, -0.22, 0.0), (0.66, 0.22, 0.0), (np.nan,) * 3
RISING, STANDING, WALKING_OFF = (0.81, 0.32, 0.175), (0.96, 0.42, 0.35), (0.991, 0.604, 0.35)
SENSOR = np.array([0.05, 0.02, 0.22])
PLACES: list[tuple[str, int, dict[float, Place]]] = [
    ("two-still", 0, {0.0: LEFT, 0.8: LEFT, 7.0: LEFT}),
    ("two-still", 1, {0.0: RIGHT, 0.8: RIGHT, 7.0: RIGHT}),
    ("two-lean", 0, {0.8: (0.62, -0.12, -0.02), 2.4: (0.62, -0.32, -0.02), 1.6: (0.60, -0.22, 0.0)}),
    ("two-lean", 1, {0.598: (0.66, 0.12, -0.02), 1.966: (0.66, 0.32, -0.02)}),
    ("two-one-leans", 0, {0.8: LEFT, 2.4: LEFT, 3.2: LEFT}),
    ("two-one-leans", 1, {0.598: (0.66, 0.12, -0.02), 1.966: (0.66, 0.32, -0.02)}),
    ("two-pass", 0, {0.0: LEFT, 1.6: LEFT, 9.6: LEFT}),
    ("two-pass", 1, {0.0: AWAY, 1.2: (1.3, -0.719, 0.35), 1.6: (1.3, 0.0, 0.35), 2.0: (1.3, 0.719, 0.35)}),
    ("two-pass", 1, {3.2: AWAY, 5.2: (1.3, 0.719, 0.35), 5.6: (1.3, 0.0, 0.35), 9.2: (1.3, -0.719, 0.35)}),
    ("two-exchange", 0, {0.0: LEFT, 4.0: LEFT, 4.5: (0.57, -0.11, 0.0), 5.0: (0.52, 0.0, 0.0), 6.0: RIGHT}),
    ("two-exchange", 0, {10.0: RIGHT, 11.0: (0.52, 0.0, 0.0), 12.0: LEFT, 16.0: LEFT, 18.0: RIGHT}),
    ("two-exchange", 1, {4.0: RIGHT, 5.0: (0.99, 0.0, 0.0), 6.0: LEFT, 10.0: LEFT, 12.0: RIGHT}),
    ("two-leave", 0, {0.0: LEFT, 5.0: LEFT, 10.6: LEFT}),
    ("two-leave", 1, {0.0: RIGHT, 4.0: RIGHT, 4.5: RISING, 5.0: STANDING, 5.4: WALKING_OFF, 6.6: AWAY}),
    (
        "two-leave",
        1,
        {8.0: AWAY, 9.2: WALKING_OFF, 9.6: STANDING, 10.1: RISING, 10.6: RIGHT, 900.0: RIGHT},
    ),
    ("two-sit", 0, {0.0: LEFT, 3.6: LEFT, 4.6: LEFT}),
    ("two-sit", 1, {0.0: AWAY, 2.0: AWAY, 3.2: WALKING_OFF, 3.6: STANDING, 4.1: RISING, 4.6: RIGHT}),
]


def middles(motion: str, times_s: F64) -> F64:
    """(n, 2, 3) the midpoints of two people's eyes."""
    return true_eyes_of_two(motion, times_s).reshape(-1, 2, 2, 3).mean(axis=2)


@pytest.mark.parametrize(("motion", "person", "places"), PLACES)
def test_people_are_in_their_places_apart_from_swaying(motion: str, person: int, places: dict[float, Place]) -> None:
    found = middles(motion, np.array(list(places)))[:, person]
    np.testing.assert_allclose(found, list(places.values()), atol=0.0035)


def test_heads_tilt_as_they_lean_and_stay_level_when_walking() -> None:
    times_s = np.array([0.8, 2.4, 1.966])
    down_m = -np.diff(true_eyes_of_two("two-lean", times_s).reshape(3, 2, 2, 3)[..., 2], axis=2)[..., 0]
    np.testing.assert_allclose([down_m[0, 0], down_m[1, 0], down_m[2, 1]], [0.0038, -0.0038, 0.0038], atol=1e-4)
    eyes = true_eyes_of_two("two-exchange", times_s)
    np.testing.assert_allclose(eyes[:, ::2, 2], eyes[:, 1::2, 2], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(eyes[:, ::2] - eyes[:, 1::2], axis=2), 0.063)


def test_people_who_sit_still_do_not_sway_in_step() -> None:
    off_m = middles("two-still", np.arange(0.0, 30.0, 0.1)) - [LEFT, RIGHT]
    assert 0.001 < np.abs(off_m[:, 0]).max() < 0.0022 and 0.001 < np.abs(off_m[:, 1]).max() < 0.0022
    assert np.abs(off_m[:, 0] - off_m[:, 1]).max() > 0.003


def test_the_sensor_sees_35_degrees_to_either_side() -> None:
    y_m = middles("two-pass", np.arange(0.0, 3.2, 0.001))[:, 1, 1]
    assert np.nanmin(y_m) == pytest.approx(-0.855, abs=0.002) and np.nanmax(y_m) == pytest.approx(0.895, abs=0.002)


@pytest.mark.parametrize(("aside_m", "is_hidden"), [(0.19, False), (0.17, True), (-0.17, True), (-0.19, False)])
@pytest.mark.parametrize("axis", [1, 2])
def test_a_head_hides_what_is_behind_its_width(aside_m: float, axis: int, is_hidden: bool) -> None:
    near, far = (np.tile(SENSOR + np.array([x_m, 0.0, 0.0]), (2, 1)) for x_m in (0.5, 1.25))
    far[:, axis] += aside_m
    gone = np.full((2, 3), np.nan)
    eyes = np.stack([np.vstack(pair) for pair in ((near, far), (far, near), (near, gone), (gone, far))])
    assert hidden(eyes).tolist() == [[False, is_hidden], [is_hidden, False], [False, False], [False, False]]


def test_two_people_never_touch() -> None:
    for motion in MOTIONS_OF_TWO:
        found = middles(motion, np.arange(0.0, 24.0, 0.05))
        assert np.nanmin(np.linalg.norm(found[:, 0] - found[:, 1], axis=1)) > 0.2


def test_a_perfect_sensor_sees_everybody_in_view_nearest_first() -> None:
    samples = observe_two("two-exchange", seconds=8.0, rate_hz=30.0, noise_m=0.0, outliers=0.0, dropout_every_s=0.0)
    assert [sample.sequence for sample in samples] == list(range(1, 241))
    assert [sample.capture_ns for sample in samples[:4]] == [0, 33_333_333, 66_666_667, 100_000_000]
    first = [1, 0]  # who is nearer, before and after the exchange: the one on the left
    for sample, nearest in ((samples[30], 0), (samples[200], 1)):
        assert sample.true_eyes_m is not None
        true_m = sample.true_eyes_m.reshape(2, 2, 3)
        for person, who in zip(sample.people, (nearest, first[nearest]), strict=True):
            np.testing.assert_array_equal(person.eyes_m, true_m[who])
            assert person.confidence.tolist() == [1.0, 1.0]
    seen = [len(sample.people) for sample in observe_two("two-pass", seconds=4.0, rate_hz=30.0, outliers=0.0)]
    assert set(seen[:34]) == {1} and set(seen[34:64]) == {2} and set(seen[64:114]) == {1} and set(seen[114:]) == {0}


def test_a_sensor_errs_unless_told_otherwise() -> None:
    samples = observe_two("two-still", seconds=20.0, rate_hz=30.0)
    assert np.mean([len(sample.people) == 0 for sample in samples]) == pytest.approx(0.05, abs=0.004)
    seen = [sample for sample in samples if len(sample.people) == 2 and sample.true_eyes_m is not None]
    off_m = np.abs([np.ravel([one.eyes_m for one in sample.people]) - np.ravel(sample.true_eyes_m) for sample in seen])
    assert 0.0018 < np.median(off_m) < 0.0023 and 0.01 < np.mean(off_m > 0.015) < 0.06
    assert len({str(observe_two("two-still", seconds=1.0, rate_hz=30.0, seed=seed)[0].eyes) for seed in (1, 1, 2)}) == 2
