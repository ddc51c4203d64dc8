"""Tests that several people are told apart, and who is served."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.clock import NS_PER_S
from runtime.eyes.association import assigned
from runtime.eyes.people import CROWD, ONE_HEAD, People
from runtime.eyes.plausibility import BEHIND, MILLIMETRES, NOT_NEWER
from runtime.eyes.rest import RestWatch
from runtime.eyes.tracker import ELSEWHERE, UNCERTAIN, Tracker
from runtime.eyes.two_people import MOTIONS_OF_TWO, observe_two
from runtime.records import F64, EyePoints, SensorFrame

RATE_HZ = 30
MS = 1_000_000


def people(*, most_served: int = 2, join_s: float = 1.0) -> People:
    return People(Tracker, lambda: None, most_served=most_served, join_s=join_s, in_front_m=0.07)


def head(*place_m: float, confidence: float = 1.0, apart_m: float = 0.063) -> EyePoints:
    eyes_m = np.array([place_m]) + apart_m / 2 * np.array([[0, -1, 0], [0, 1, 0]])
    return EyePoints(eyes_m, np.array([1.0, confidence]))


def fed(crowd: People, *heads: EyePoints, seconds: float, begin_s: float = 0.0) -> list[list[int]]:
    """Numbers of the people served after each sample with the same heads."""
    served = []
    for n in range(round(seconds * RATE_HZ)):
        crowd.update(heads, capture_ns=round((begin_s + n / RATE_HZ) * NS_PER_S) + 1)
        served.append([person.number for person in crowd.served])
    return served


def whose(true_m: F64, middle_m: F64) -> int | None:
    """Index of the nearest of two people, or None if neither is near."""
    away_m = np.linalg.norm(true_m.reshape(2, 2, 3).mean(axis=1) - middle_m, axis=1)
    return None if np.isnan(away_m).all() or np.nanmin(away_m) > 0.2 else int(np.nanargmin(away_m))


def owners(samples: list[SensorFrame], *, join_s: float = 1.0) -> dict[int, set[int]]:
    """The true people whose eyes each served number has had."""
    crowd, had = people(join_s=join_s), dict[int, set[int]]()
    for sample in samples:
        crowd.update(sample.people, capture_ns=sample.capture_ns)
        for person in crowd.served:
            middle_m, true_m = person.middle_m(sample.capture_ns), sample.true_eyes_m
            if middle_m is not None and true_m is not None and (owner := whose(true_m, middle_m)) is not None:
                had.setdefault(person.number, set()).add(owner)
    return had


@pytest.mark.parametrize("motion", MOTIONS_OF_TWO)
def test_no_number_ever_gets_the_eyes_of_two_people(motion: str) -> None:
    had = owners(observe_two(motion, seconds=9.0, rate_hz=RATE_HZ, seed=5))
    assert all(len(owner) == 1 for owner in had.values())
    assert set.union(*had.values()) == ({0} if motion == "two-pass" else {0, 1})  # who only passes is not served


@settings(max_examples=4, deadline=None)
@given(st.data())
def test_hiding_and_missing_faces_never_confuse_two_people(data: st.DataObject) -> None:
    motion = data.draw(st.sampled_from(["two-exchange", "two-lean", "two-still"]))
    samples = observe_two(motion, seconds=7.0, rate_hz=RATE_HZ, seed=data.draw(st.integers(1, 10**6)))
    shown = []
    missing: dict[int, tuple[float, float]] = {}
    for who in (0, 1):
        begin_s = data.draw(st.floats(1.5, 6.0))
        missing[who] = begin_s, begin_s + data.draw(st.floats(0.0, 2.0))
    for sample in samples:
        time_s, true_m = sample.capture_ns / NS_PER_S, sample.true_eyes_m
        assert true_m is not None
        gone = [who for who, (begin_s, end_s) in missing.items() if begin_s <= time_s < end_s]
        kept = [one for one in sample.people if whose(true_m, one.eyes_m.mean(axis=0)) not in gone]
        first, others = (kept[0] if kept else None), tuple(kept[1:])
        shown.append(SensorFrame(sample.sequence, sample.capture_ns, first, true_eyes_m=true_m, others=others))
    assert all(len(owner) == 1 for owner in owners(shown, join_s=0.2).values())


@pytest.mark.parametrize(("distance_m", "radius_m", "heads", "doubt"), [
    ((0.10, 0.11), (0.3, 0.3), [None, None], True), ((0.002, 0.11), (0.03, 0.3), [0, None], False),
    ((0.0, 0.25), (0.2, 0.3), [None, None], True), ((0.0, 0.26), (0.2, 0.3), [0, None], False),
    ((0.25, 0.6), (0.25, 0.5), [0, None], False),  # as far as the first can have come
])  # fmt: skip
def test_a_head_that_may_be_either_person_s_is_given_to_nobody(
    distance_m: tuple[float, float], radius_m: tuple[float, float], heads: list[int | None], doubt: bool
) -> None:
    """The squared distances in thirds of the radius, plus six times their logarithms, must differ by nine."""
    assert assigned(np.array([distance_m]).T, np.array([radius_m]).T) == (heads, [doubt] * 2)


@given(st.permutations(range(3)), st.lists(st.floats(0.0, 0.03), min_size=3, max_size=3))
def test_heads_far_apart_are_assigned_in_any_order(order: list[int], off_m: list[float]) -> None:
    distance_m = np.full((3, 3), 0.4)
    for person, column in enumerate(order):
        distance_m[person, column] = off_m[person]
    assert assigned(distance_m, np.full((3, 3), 0.05))[0] == list(order)


def test_the_nearest_is_served_at_once_and_a_second_after_a_wait() -> None:
    served = fed(people(join_s=0.5), head(0.6, -0.2, 0.0), head(0.8, 0.3, 0.0), seconds=0.8)
    assert served[0] == [1] and served[-1] == [1, 2]
    assert served.index([1, 2]) == pytest.approx(0.5 * RATE_HZ, abs=2)


A, B, FAR, NEAR = head(0.6, -0.2, 0.0), head(0.8, 0.3, 0.0), head(0.8, -0.2, 0.0), head(0.5, 0.2, 0.0)
THREE = head(0.6, -0.3, 0.0), head(0.7, 0.0, 0.0), head(0.8, 0.3, 0.0)


@pytest.mark.parametrize(("most_served", "join_s", "stages"), [
    (1, 1.0, [((FAR,), 1.0, [1]), ((NEAR, FAR), 2.0, [1]), ((NEAR,), 1.0, [2])]),
    (2, 0.2, [((A, B), 1.0, [1, 2]), ((B,), 1.0, [2])]), (2, 0.2, [(THREE, 2.0, [1, 2]), (THREE[::2], 1.0, [1, 3])]),
    (2, 0.5, [((A, head(1.2, 0.0, 0.0), head(0.9, 0.6, 0.0)), 0.8, [1, 3])]),
])  # fmt: skip
def test_the_nearest_are_served_and_keep_the_place_until_they_have_left(
    most_served: int, join_s: float, stages: list[Any]
) -> None:
    crowd, begin_s = people(most_served=most_served, join_s=join_s), 0.0
    for heads, seconds, served in stages:
        assert fed(crowd, *heads, seconds=seconds, begin_s=begin_s)[-1] == served and crowd.in_view == len(heads)
        begin_s += seconds


def test_one_mistaken_head_serves_nobody_else() -> None:
    crowd = people(join_s=0.0)
    fed(crowd, head(0.6, -0.2, 0.0), seconds=1.0)
    assert fed(crowd, head(0.6, -0.2, 0.0), head(0.7, 0.3, 0.0), seconds=0.05, begin_s=1.0)[-1] == [1]
    assert fed(crowd, head(0.6, -0.2, 0.0), seconds=1.0, begin_s=1.1)[-1] == [1] and crowd.in_view == 1


def test_two_samples_of_one_face_are_one_person() -> None:
    crowd = people(join_s=0.1)
    twice = head(0.6, -0.2, 0.0), head(0.64, -0.18, 0.0)
    assert fed(crowd, *twice, seconds=1.0)[-1] == [1] and crowd.in_view == 1


@pytest.mark.parametrize(("lost_s", "away_m"), [(0.3, 0.1), (0.3, 0.75), (0.4, 0.95)])
def test_somebody_hidden_comes_back_anew_and_keeps_the_place(lost_s: float, away_m: float) -> None:
    crowd = people(join_s=0.2)
    fed(crowd, A, B, seconds=1.0)
    assert fed(crowd, A, seconds=lost_s, begin_s=1.0)[-1] == [1, 2]
    served = fed(crowd, A, head(0.8, 0.3 + away_m, 0.0), seconds=0.15, begin_s=1.0 + lost_s)
    assert served[:4] == [[1, 2], [1, 2], [1, 3], [1, 3]] and crowd.in_view == 2


def test_somebody_who_cannot_have_come_from_there_takes_no_place() -> None:
    crowd = people(join_s=0.2)
    fed(crowd, A, B, seconds=1.0)
    fed(crowd, A, seconds=0.3, begin_s=1.0)
    served = fed(crowd, A, head(0.8, 1.13, 0.0), seconds=1.0, begin_s=1.3)
    assert served[3] == [1, 2] and served[-1] == [1, 3]
    assert served.index([1, 3]) == 6  # once the second is lost, half a second after being last seen


def test_somebody_hidden_for_a_moment_has_waited_all_the_same() -> None:
    crowd = people(join_s=1.0)
    fed(crowd, A, B, seconds=0.6)
    fed(crowd, A, seconds=0.3, begin_s=0.6)
    served = fed(crowd, A, head(0.8, 0.4, 0.0), seconds=0.5, begin_s=0.9)
    assert served.index([1, 3]) == pytest.approx(3, abs=1)


@pytest.mark.parametrize(("speed_m_s", "is_served"), [(0.45, True), (0.55, False), (-0.45, True), (-0.55, False)])
def test_whoever_walks_past_faster_than_half_a_metre_a_second_waits(speed_m_s: float, is_served: bool) -> None:
    crowd = people(join_s=0.5)
    for n in range(40):
        walker = head(1.2, 0.3 + speed_m_s * n / RATE_HZ, 0.4)
        crowd.update((head(0.6, -0.2, 0.0), walker), capture_ns=n * NS_PER_S // RATE_HZ)
    assert [person.number for person in crowd.served] == ([1, 2] if is_served else [1])
    assert crowd.in_view == 2


def test_each_refused_head_has_its_reason() -> None:
    good = [head(0.6, -1.2 + 0.4 * n, 0.0) for n in range(7)]
    bad = {
        UNCERTAIN: head(0.6, 0.9, 0.5, confidence=0.29),
        BEHIND: head(0.069, 0.2, 0.5),
        MILLIMETRES: head(600.0, 0.0, 500.0, apart_m=63.0),
        ONE_HEAD: head(0.6, -1.2 + 0.119, 0.0),
    }
    order = [good[0], *bad.values(), *good[1:]]
    assert people().update(order, capture_ns=1) == ["", *bad, *[""] * 5, CROWD]
    assert people().update((head(0.071, 0.2, 0.5, confidence=0.31), good[0]), capture_ns=1) == ["", ""]
    near_one_refused = head(0.6, 0.95, 0.5)
    assert people().update((bad[UNCERTAIN], near_one_refused), capture_ns=1) == [UNCERTAIN, ""]
    assert people().update((good[0], head(0.6, -1.2 + 0.121, 0.0)), capture_ns=1) == ["", ""]


def test_old_samples_are_refused_until_the_clock_was_set_back() -> None:
    crowd = people()
    assert fed(crowd, A, B, seconds=3.0)[-1] == [1, 2]
    newest_ns = round((3.0 - 1 / RATE_HZ) * NS_PER_S) + 1
    for capture_ns in (newest_ns, newest_ns - NS_PER_S + 1):
        assert crowd.update((A, B), capture_ns=capture_ns) == [NOT_NEWER] * 2
    assert crowd.update((A, B), capture_ns=newest_ns - NS_PER_S) == ["", ""]
    assert [person.number for person in crowd.served] == [3] and crowd.in_view == 1


@pytest.mark.parametrize(("unseen_ms", "label"), [(100, "predicted"), (101, "held")])
def test_who_is_missing_for_a_tenth_of_a_second_is_lost(unseen_ms: int, label: str) -> None:
    crowd = people(join_s=0.0)
    for n in range(8):
        crowd.update((A, B), capture_ns=n * 30 * MS)
    for ms in (50, unseen_ms):
        crowd.update((A,), capture_ns=(210 + ms) * MS)
    now_ns = (211 + unseen_ms) * MS
    assert [person.tracker.at(now_ns).label for person in crowd.served] == ["predicted", label]
    crowd.update((), capture_ns=now_ns)  # nobody is seen: all are lost
    assert [person.tracker.at(now_ns + 1).label for person in crowd.served] == ["held", "held"]


@pytest.mark.parametrize(("alone_s", "why"), [(10.3, ""), (10.8, ELSEWHERE)])
def test_heads_are_told_apart_for_ten_seconds_after_several(alone_s: float, why: str) -> None:
    """The second person counts for the half second in which they are lost."""
    crowd = people()
    fed(crowd, A, B, seconds=0.2)
    fed(crowd, A, seconds=alone_s, begin_s=0.2)
    assert crowd.update((head(0.8, 1.5, 0.0),), capture_ns=round((0.25 + alone_s) * NS_PER_S)) == [why]


def test_another_lone_viewer_has_another_number() -> None:
    crowd = people()
    assert fed(crowd, A, seconds=1.0)[-1] == [1] and crowd.in_view == 1
    served = fed(crowd, head(0.9, 1.5, 0.0), seconds=1.0, begin_s=1.0)
    assert served[0] == [1] and served[-1] == [2] and crowd.in_view == 1


@pytest.mark.parametrize("heads", [(A,), (A, B)])
def test_each_person_s_rest_is_watched(heads: tuple[EyePoints, ...]) -> None:
    crowd = People(Tracker, lambda: RestWatch(max_drift_m=0.001), most_served=2, join_s=0.1, in_front_m=0.07)
    fed(crowd, *heads, seconds=31 / RATE_HZ)  # a second, from the first sample on
    rests = [person.rest for person in crowd.served]
    for one, rest in zip(heads, rests, strict=True):
        assert rest is not None and rest.place is not None
        np.testing.assert_allclose(rest.place, one.eyes_m, atol=1e-9)
    crowd.renew_rest()
    assert [person.rest is not None and person.rest.place is None for person in crowd.served] == [True] * len(heads)
