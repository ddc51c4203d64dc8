"""Tests where the simulated viewer is, when, and how the simulated sensor errs."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.eyes.motions import MOTIONS, Path, minimum_jerk, observe, path_of, true_eyes

Row = tuple[float, float, float, float, float]  # seconds; midpoint x, y, z in m; how much higher the right eye is in mm
ROWS: dict[str, list[Row]] = {
    "still": [(0.0, 0.6, 0.0, 0.0, 0.0), (10.0, 0.6, 0.0, 0.0, 0.0)],
    "lean": [(0.0, 0.63, 0.0, 0.0, 0.0), (0.8, 0.6, 0.15, -0.03, -5.7), (2.4, 0.6, -0.15, -0.03, 5.7)],
    "nod": [(0.25, 0.616, 0.0, 0.009, 0.0), (0.75, 0.574, 0.0, -0.02, 0.0), (1.25, 0.631, 0.0, 0.0165, 0.0),
            (2.75, 0.586, 0.0, -0.011, 0.0), (3.5, 0.6, 0.0, 0.0, 0.0), (6.25, 0.631, 0.0, 0.0165, 0.0)],
    "walk": [(0.0, 0.8, -1.0, 0.0, 35.6), (1.75, 0.883, 0.0, 0.018, 0.0), (3.5, 1.018, 1.0, -0.016, -35.6),
             (3.75, 0.992, 0.993, 0.014, -35.4), (7.0, 0.784, -1.0, 0.019, 35.6), (99.4, 0.872, -0.365, -0.015, 13.7)],
    "stop-and-go": [(2.0, 0.732, -0.109, -0.02, 4.1), (3.0, 0.732, -0.109, -0.02, 4.1),
                    (4.0, 0.747, 0.116, -0.003, -4.4), (5.0, 0.578, -0.023, 0.001, 0.9),
                    (10.0, 0.774, 0.05, 0.001, -1.9)],
}  # fmt: skip


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_viewer_is_in_place_apart_from_swaying(motion: str) -> None:
    times_s, *_ = rows = np.array(ROWS[motion]).T
    eyes = true_eyes(motion, times_s)
    np.testing.assert_allclose(eyes.mean(axis=1), rows[1:4].T, atol=0.0035)
    np.testing.assert_allclose(1000 * (eyes[:, 1] - eyes[:, 0])[:, 2], rows[4], atol=0.15)
    np.testing.assert_allclose(np.linalg.norm(eyes[:, 1] - eyes[:, 0], axis=1), 0.063)


def test_a_movement_of_minimum_jerk_starts_and_ends_at_rest() -> None:
    places = minimum_jerk(
        np.array([-1.0, 1.0, 1.5, 2.0, 3.0, 9.0]), knots_s=np.array([1.0, 3.0]), values=np.array([2.0, 4.0])
    )
    np.testing.assert_allclose(places, [2.0, 2.0, 2.20703125, 3.0, 4.0, 4.0])


def test_a_path_starts_elsewhere_at_another_pace_size_and_side() -> None:
    eyes = true_eyes("lean", np.array([0.0, 0.4, 0.8]), path=Path(start_s=0.8, pace=2.0, size=0.5, side=-1.0))
    expected = [(0.6, -0.075, -0.015), (0.585, 0.0, 0.0), (0.6, 0.075, -0.015)]
    np.testing.assert_allclose(eyes.mean(axis=1), expected, atol=0.002)
    nods = [true_eyes("nod", np.array([1.25]), path=Path(size=size)).mean(axis=1)[0, 0] for size in (1.0, 0.5)]
    np.testing.assert_allclose(nods, [0.631, 0.617], atol=0.002)


def test_seeds_give_paths_of_similar_pace_and_size_to_both_sides() -> None:
    assert path_of(0) == Path()
    paths = [path_of(seed) for seed in range(1, 60)]
    for values, low, high in (([path.pace for path in paths], 0.85, 1.1), ([path.size for path in paths], 0.85, 1.1),
                              ([path.start_s for path in paths], 0.0, 600.0)):  # fmt: skip
        edge = 0.1 * (high - low)
        assert low <= min(values) < low + edge and high - edge < max(values) <= high
    assert {path.side for path in paths} == {-1.0, 1.0}


def test_a_wrong_sample_is_off_in_either_eye_or_both() -> None:
    observed = observe("lean", seconds=40.0, rate_hz=30.0, noise_m=0.0, outliers=0.5, dropout_every_s=0.0)
    eyes = np.array([one.points.eyes_m for one in observed if one.points is not None])
    off_m = eyes - true_eyes("lean", np.arange(1200) / 30)
    away_m = np.linalg.norm(off_m, axis=2)
    wrong = away_m[away_m > 1e-9]
    assert 0.04 <= wrong.min() < 0.045 and 0.195 < wrong.max() <= 0.2
    kinds = [np.mean(((away_m > 1e-9) == kind).all(axis=1)) for kind in ([1, 0], [0, 1], [1, 1], [0, 0])]
    np.testing.assert_allclose(kinds, [1 / 6, 1 / 6, 1 / 6, 1 / 2], atol=0.04)
    both = off_m[(away_m > 1e-9).all(axis=1)]
    np.testing.assert_allclose(both[:, 0], both[:, 1], atol=1e-12)
    assert (np.abs(both[:, 0].mean(axis=0)) < 0.02).all()


def test_a_sensor_misses_the_face_for_a_fifth_of_a_second() -> None:
    observed = observe("still", seconds=10.0, rate_hz=30.0)
    assert [round(one.capture_ns / 1e6) for one in observed[:4]] == [0, 33, 67, 100] and len(observed) == 300
    assert [n for n, one in enumerate(observed) if one.points is None] == [*range(114, 120), *range(234, 240)]
    often = observe("still", seconds=2.0, rate_hz=8.0, dropout_every_s=0.5)
    assert [n for n, one in enumerate(often) if one.points is None] == [11, 15]  # never in the first second
    found = np.array([one.points.eyes_m for one in observed if one.points is not None])
    typical_m = np.median(np.abs(found - np.median(found, axis=0)))
    assert 0.0018 < typical_m < 0.0026  # of a deviation of 3 mm
    assert not np.array_equal(found[0], observe("still", seconds=1.0, rate_hz=30.0, seed=2)[0].points.eyes_m)
