"""Tests which state each refresh leads to, and that each change is reported once with its reason."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clock import NS_PER_S
from runtime.frame.states import PARTS, Conditions, Lateness, StateMachine, judge
from runtime.records import State

EYES = st.sampled_from(["exact", "interpolated", "predicted", "rested", "held", "none"])
CONDITIONS = st.builds(
    Conditions,
    eyes=EYES,
    missing=st.dictionaries(st.sampled_from(PARTS), st.text("abc", min_size=1, max_size=3)),
    presented=st.booleans(),
    flat_wanted=st.booleans(),
    stopping=st.sampled_from(["", "SIGTERM"]),
    limited=st.sampled_from(["", "too far"]),
    paused=st.booleans(),
)


def well(eyes: str = "predicted", **changes: Any) -> Conditions:
    return Conditions(**{"eyes": eyes, "missing": {}, "presented": True, **changes})


def test_what_is_missing_is_named_with_its_reason() -> None:
    machine = StateMachine(now_ns=0)
    assert machine.update(well(missing={"panel": "DUMMY1 was disconnected", "sensor": "unplugged"}), now_ns=1)
    assert machine.name == "degraded: sensor, panel"
    assert machine.reason == "sensor: unplugged; panel: DUMMY1 was disconnected"
    machine.update(well(missing={"sensor": "rtsp://operator:pass@camera/1: cannot be opened"}), now_ns=2)
    assert machine.reason == "sensor: rtsp://camera/1: cannot be opened"  # black box and service's status have it too


def test_a_transition_is_told_once_and_again_when_what_is_missing_changes() -> None:
    machine = StateMachine(now_ns=0)
    told = [
        machine.update(conditions, now_ns=now) and machine.name
        for now, conditions in enumerate(
            [well(), well(), well(missing={"sensor": "x"}), well(missing={"sensor": "y"}),
             well(missing={"sensor": "x", "model": "z"}), well()]
        )
    ]  # fmt: skip
    assert told == [
        "tracking", False, "degraded: sensor", False, "degraded: sensor, model", "tracking",
    ]  # fmt: skip


@given(st.lists(CONDITIONS, max_size=20))
def test_stopping_is_never_left(history: Any) -> None:
    machine = StateMachine(now_ns=0)
    stopped = False
    for now_ns, conditions in enumerate(history, start=1):
        change = machine.update(conditions, now_ns=now_ns)
        assert not (stopped and change)
        stopped = stopped or bool(conditions.stopping)
        assert (machine.state is State.STOPPING) == stopped


@given(st.lists(st.tuples(CONDITIONS, st.integers(1, 10**9)), min_size=1, max_size=20))
def test_every_nanosecond_is_counted_in_one_state(history: Any) -> None:
    now_ns = 1000
    machine = StateMachine(now_ns=now_ns)
    for conditions, passed_ns in history:
        now_ns += passed_ns
        machine.update(conditions, now_ns=now_ns)
    total = sum(machine.seconds(now_ns=now_ns + 500).values())
    assert abs(total - (now_ns - 1000 + 500) / 1e9) < 1e-9


@given(CONDITIONS)
def test_the_reason_is_never_empty_and_names_every_missing_part(conditions: Any) -> None:
    state, reason = judge(conditions)
    assert reason
    if state is State.DEGRADED:
        assert all(f"{part}: {why}" in reason for part, why in conditions.missing.items())


def test_before_the_first_frame_the_state_names_what_it_waits_for() -> None:
    waiting = well(presented=False, missing={"panel": "DUMMY1 is not connected"})
    assert judge(waiting) == (State.STARTING, "waiting for panel: DUMMY1 is not connected")
    assert judge(well(presented=False)) == (State.STARTING, "no frame has been presented yet")


def shown(lateness: Lateness, *, of_60: int, from_s: int, to_s: int) -> list[str]:
    """Messages at every refresh of a display of 60 Hz that shows only some of the refreshes of each second."""
    told = []
    for number in range(60 * from_s, 60 * to_s):
        presented = number * of_60 // 60 != (number - 1) * of_60 // 60
        told.append(lateness.update(presented=presented, now_ns=number * NS_PER_S // 60))
    return told


@pytest.mark.parametrize(("of_60", "late"), [(60, False), (55, False), (54, False), (51, True), (40, True)])
def test_a_display_is_late_below_nine_tenths_of_its_rate(of_60: int, late: bool) -> None:
    told = shown(Lateness(NS_PER_S // 60), of_60=of_60, from_s=0, to_s=5)
    assert not any(told[: 2 * 60]), "a second to count, and a second of patience"
    assert bool(told[-1]) == late
    assert not late or told[-1] == f"late: {of_60} of 60 refreshes per second"


@pytest.mark.parametrize(("of_60", "late"), [(54, True), (55, True), (58, False)])
def test_a_late_display_is_on_time_again_only_well_above_that(of_60: int, late: bool) -> None:
    lateness = Lateness(NS_PER_S // 60)
    assert shown(lateness, of_60=40, from_s=0, to_s=5)[-1]
    assert bool(shown(lateness, of_60=of_60, from_s=5, to_s=10)[-1]) == late


def test_the_count_of_a_late_display_changes_once_a_second() -> None:
    lateness = Lateness(NS_PER_S // 60)
    shown(lateness, of_60=48, from_s=1000, to_s=1005)
    told = shown(lateness, of_60=30, from_s=1005, to_s=1007)
    changes = [n for n in range(1, len(told)) if told[n] != told[n - 1]]
    assert all(later - earlier == 60 for earlier, later in itertools.pairwise(changes)) and 1 <= len(changes) <= 2
    assert told[-1] == "late: 30 of 60 refreshes per second"


def test_a_second_that_was_late_by_itself_is_forgiven() -> None:
    lateness = Lateness(NS_PER_S // 60)
    told = [*shown(lateness, of_60=60, from_s=0, to_s=3), *shown(lateness, of_60=50, from_s=3, to_s=4)]
    assert not any([*told, *shown(lateness, of_60=60, from_s=4, to_s=6)])
