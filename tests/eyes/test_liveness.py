"""Tests that a face which moves or blinks is told from a picture."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.eyes.liveness import Liveness, Sign

S = 10**9


def face(x: float = 0.0, *, blinks: bool = False) -> Sign:
    """A face whose eyes are 10 pixels apart, moved by x times that."""
    return Sign(np.array([10 * x, 0.0]), 10.0, blinks, np.eye(468)[0])


@pytest.mark.parametrize(("event", "due_s"), [
    (face(), [7, 8, 9, 10]), (face(0.039), [7, 8, 9, 10]), (face(0.041), [9, 10]), (face(blinks=True), [9, 10]),
])  # fmt: skip
def test_somebody_else_is_looked_for_once_a_second_after_six_still_ones(event: Sign, due_s: list[int]) -> None:
    watch = Liveness()
    faces = [event if (half >= 6 and not event.is_blinking) or half == 6 else face() for half in range(2, 22)]
    told = [watch.is_due(one, half * S // 2) for half, one in enumerate(faces, start=2)]
    assert [half / 2 for half, is_due in enumerate(told, start=2) if is_due] == due_s


@pytest.mark.parametrize(("later", "lives"), [(face(0.079), False), (face(0.081), True), (face(blinks=True), True)])
def test_a_viewer_lives_who_has_moved_or_blinked(later: Sign, lives: bool) -> None:
    watch = Liveness()
    for number, one in enumerate((face(), face(0.05), later)):
        watch.is_due(one, number * S)
    assert watch.has_lived == lives


@pytest.mark.parametrize(("later", "found"), [
    (face(0.079), None), (face(0.081), 1), (face(1.49), 1), (face(1.51), None), (face(blinks=True), 1),
])  # fmt: skip
def test_a_person_among_others_is_the_first_who_moved_or_blinked(later: Sign, found: int | None) -> None:
    watch, still = Liveness(), face(9.0)
    assert watch.person_among([still, face()]) is None
    assert watch.person_among([still, later, face(9.5, blinks=True)]) == (2 if found is None else found)


def test_a_picture_is_known_by_its_place_and_looks() -> None:
    watch = Liveness()
    watch.is_due(face(), 0)
    assert not watch.is_picture(face(), alike=0.9)
    watch.mark_viewer()
    told = [watch.is_picture(face(x), alike=alike) for x, alike in ((0.039, 0.9), (0.041, 0.9), (0.0, 1.0))]
    assert told == [True, False, False]
