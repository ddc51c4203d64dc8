"""Tests the true eyes of a recording, between its samples and of each person who is served."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS
from runtime.frame.truth import TrueEyes
from runtime.records import PersonAccount, RefreshAccount, State
from tests.frame.fakes import EYES, aside

LEFT, RIGHT = aside(-0.3), aside(0.3)
NOBODY = np.full((2, 3), np.nan)


def known(*samples: tuple[int, Any]) -> TrueEyes:
    """True eyes at so many milliseconds."""
    truth = TrueEyes()
    for time_ms, eyes_m in samples:
        truth.add(time_ms * NS_PER_MS, eyes_m)
    return truth


def account(*people: tuple[int, Any], time_ms: int = 0) -> RefreshAccount:
    """A refresh at which numbered people are served, each where a tracker finds them."""
    served = tuple(PersonAccount(number, eyes_m, None) for number, eyes_m in people)
    return RefreshAccount(
        1, 0, 0, 0, None, "none", None, State.TRACKING, None, None, None, "skipped", True, 0.0,
        photon_ns=time_ms * NS_PER_MS, people=served,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("time_ms", "y_m"),
    [(99, None), (100, 0.0), (101, 0.001), (150, 0.05), (300, 0.2), (301, None), (500, None), (501, 0.5), (502, None)],
)
def test_eyes_lie_between_samples_at_most_a_fifth_of_a_second_apart(time_ms: int, y_m: float | None) -> None:
    truth = known((100, aside(0.0)), (200, aside(0.1)), (300, aside(0.2)), (501, aside(0.5)))
    assert known((0, EYES), (200, aside(0.4))).at(50 * NS_PER_MS) == pytest.approx(aside(0.1))
    found_m = truth.at(time_ms * NS_PER_MS)
    assert found_m is None if y_m is None else found_m == pytest.approx(aside(y_m))


def test_only_later_samples_can_bring_the_eyes_of_a_time_to_come() -> None:
    truth = known((100, EYES))
    assert not truth.may_come(100 * NS_PER_MS) and truth.may_come(101 * NS_PER_MS)
    truth.end()
    assert not truth.may_come(101 * NS_PER_MS)
    assert TrueEyes().at(0) is None and not TrueEyes().may_come(1) and not TrueEyes().is_recorded


def test_samples_out_of_order_are_ignored_and_old_ones_forgotten() -> None:
    truth = known((100, EYES), (100, aside(0.1)), (50, aside(0.2)))
    assert truth.at(100 * NS_PER_MS) == pytest.approx(EYES) and truth.at(50 * NS_PER_MS) is None
    truth = known(*((ms, EYES) for ms in range(512)))
    assert truth.at(0) is not None
    truth.add(512 * NS_PER_MS, EYES)
    assert truth.at(0) is None and truth.at(NS_PER_MS) is not None


def test_a_single_true_person_is_the_first_who_is_served() -> None:
    truth = known((0, RIGHT))
    truth.meet(account((3, LEFT)))
    assert truth.place_of(3) == truth.place_of(8) == 0
    found = truth.of(account((3, EYES), (8, EYES)))
    assert found.true_eyes_m is RIGHT and [person.true_eyes_m is RIGHT for person in found.people] == [True, False]
    assert truth.of(account()).true_eyes_m is RIGHT
    late = account((3, EYES), time_ms=1)
    assert truth.of(late) is late, "not known yet"


def test_each_of_several_people_stays_the_true_person_they_were_nearest_to() -> None:
    truth = known((0, np.concatenate([LEFT, RIGHT])))
    assert truth.place_of(7) is None
    truth.meet(account((7, aside(0.2))))
    truth.meet(account((7, LEFT), (8, aside(0.1)), (9, EYES)))  # the nearest of the others; nobody is left for the last
    assert [truth.place_of(number) for number in (7, 8, 9)] == [1, 0, None]
    found = truth.of(account((7, LEFT), (8, RIGHT), (9, EYES)))
    assert found.true_eyes_m == pytest.approx(RIGHT)
    eyes_m = [person.true_eyes_m for person in found.people]
    assert eyes_m[0] == pytest.approx(RIGHT) and eyes_m[1] == pytest.approx(LEFT) and eyes_m[2] is None


def test_who_is_absent_from_the_recording_has_no_true_eyes() -> None:
    truth = known((0, np.concatenate([NOBODY, RIGHT])))
    truth.meet(account((1, LEFT), (2, LEFT)))
    assert [truth.place_of(number) for number in (1, 2)] == [1, None]
    assert truth.of(account((2, LEFT))).true_eyes_m is None
    assert truth.of(account()).true_eyes_m == pytest.approx(RIGHT), "before anyone is served, the first who is present"
    truth.add(NS_PER_MS, EYES)  # another recording, of one person
    assert truth.at(0) is None and truth.of(account((2, LEFT), time_ms=1)).true_eyes_m is EYES
