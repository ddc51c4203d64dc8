"""Tests that all people in a picture are found, each with the right eyes, and pictures of people are not."""

from __future__ import annotations

import numpy as np

from runtime.eyes.detect import EyeFinder
from runtime.records import EyePoints
from tests.eyes.scene import camera, eileen, frame, grace, scene

CAMERA = camera(640, 480, 65.0)
PEOPLE = (eileen(), grace())


def found_over(finder: EyeFinder, places: np.ndarray) -> list[tuple[EyePoints, ...]]:
    """People found in each picture, with (n, 2, 3) m places of Eileen and Grace."""
    found = []
    for number, (first, second) in enumerate(places):
        colour, depth, _ = scene(first, second, portraits=PEOPLE, intrinsics=CAMERA, noise=3, seed=number)
        found.append(finder.find_all(frame(colour, depth, CAMERA, number=number + 1)))
    return found


def test_two_people_are_found_nearest_first_with_left_and_right_eyes() -> None:
    near, far = np.array([-0.18, 0.02, 0.6]), np.array([0.2, -0.03, 0.8])
    for first, second in ((near, far), (far, near)):
        colour, depth, truth = scene(first, second, portraits=PEOPLE, intrinsics=CAMERA)
        people = EyeFinder(most_people=2).find_all(frame(colour, depth, CAMERA), is_still=True)
        for person, true_m in zip(people, reversed(truth), strict=True):  # the truth has the farthest first
            assert np.abs(person.eyes_m - true_m).max() < 0.006
    finder = EyeFinder(most_people=2)
    for places in ((near,), (near, far)):  # whoever comes in the next picture is found at once
        colour, depth, _ = scene(*places, portraits=PEOPLE[: len(places)], intrinsics=CAMERA)
        assert len(finder.find_all(frame(colour, depth, CAMERA, number=len(places)), is_still=True)) == len(places)


def test_a_second_face_is_a_person_once_it_has_moved() -> None:
    count = 14
    still = np.tile([-0.18, 0.0, 0.6], (count, 1))
    poster = np.tile([0.2, 0.0, 0.75], (count, 1))
    person = poster + np.outer(np.minimum(np.arange(count), 8), [0.003, 0.0, 0.0])
    found = found_over(EyeFinder(most_people=2), np.stack([still, person], 1))
    assert [len(people) for people in found[:2]] == [1, 1] and len(found[-1]) == 2
    assert max(len(people) for people in found_over(EyeFinder(most_people=2), np.stack([still, poster], 1))) == 1


def test_a_finder_of_one_ignores_the_others() -> None:
    places = np.array([[-0.18, 0.0, 0.6], [0.2, 0.0, 0.7]])
    sample = frame(*scene(*places, portraits=PEOPLE, intrinsics=CAMERA)[:2], CAMERA)
    finder = EyeFinder()
    (alone,) = finder.find_all(sample, is_still=True)
    finder.forget()
    assert (one := finder.find(sample)) is not None and np.array_equal(alone.eyes_m, one.eyes_m)
