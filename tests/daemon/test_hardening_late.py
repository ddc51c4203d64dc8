"""Where the refreshes come too late for the display, the state's reason says so."""

from __future__ import annotations

from typing import Any

import pytest

from runtime.clock import NS_PER_S
from runtime.frame.states import Conditions, Lateness, judge
from runtime.records import State
from tests.frame.fakes import PERIOD_NS, Stage, solution

PERIOD = NS_PER_S // 60


def told(lateness: Lateness, *, period_ns: int, seconds: float, start_ns: int, presented: bool = True) -> list[str]:
    count = int(seconds * NS_PER_S / period_ns)
    return [lateness.update(presented=presented, now_ns=start_ns + (k + 1) * period_ns) for k in range(count)]


def test_a_second_on_end_of_too_few_refreshes_is_told_with_both_figures() -> None:
    said = told(Lateness(PERIOD), period_ns=-(-NS_PER_S // 38), seconds=5, start_ns=0)
    assert not any(said[:38])  # not before a second has passed
    assert said[-1] == "late: 38 of 60 refreshes a second"


def test_once_it_is_in_time_again_it_is_told_no_more() -> None:
    lateness = Lateness(PERIOD)
    assert told(lateness, period_ns=NS_PER_S // 38, seconds=5, start_ns=0)[-1]
    assert told(lateness, period_ns=PERIOD, seconds=3, start_ns=5 * NS_PER_S)[-1] == ""


@pytest.mark.parametrize(
    ("changes", "state"),
    [
        ({"eyes": "predicted"}, State.TRACKING),
        ({"eyes": "held"}, State.HOLDING),
        ({"eyes": "none"}, State.FLAT),
        ({"eyes": "exact", "flat_wanted": True}, State.FLAT),
    ],
)
def test_every_state_that_shows_something_says_it(changes: Any, state: Any) -> None:
    conditions = Conditions(**{"missing": {}, "presented": True, "late": "late: 38 of 60 refreshes a second"} | changes)
    assert judge(conditions)[0] is state
    assert judge(conditions)[1].endswith("late: 38 of 60 refreshes a second")


def test_panels_that_take_longer_than_a_period_are_told_by_the_presenter() -> None:
    stage = Stage()
    stage.solver.hand_over(solved=solution(1))
    present = stage.panels.present

    def slow(frame: Any, *, unchanged: bool = False) -> Any:
        stage.clock.advance_ns(round(1.6 * PERIOD_NS))
        return present(frame, unchanged=unchanged)

    stage.refresh(150)
    assert "late" not in stage.presenter.machine.reason
    stage.panels.present = slow
    stage.refresh(150)
    assert stage.presenter.machine.state is State.TRACKING
    assert "late: " in stage.presenter.machine.reason
    now = stage.presenter.stats.rates_now()["fps_now"]
    told_now = int(stage.presenter.machine.reason.split("late: ")[1].split()[0])
    assert abs(told_now - now) <= 2
