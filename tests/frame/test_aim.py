"""Tests that a solution is requested for the middle of the refreshes that will show it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.frame.aim import Slots, focused
from runtime.frame.effort import Costs
from runtime.model.solver import FOCUS_STEPS
from runtime.records import Effort, Solution
from tests.frame.fakes import EYES

PERIOD_NS = 16_000_000


@given(cost_ns=st.integers(1, 400_000_000), wait_ns=st.integers(0, PERIOD_NS))
def test_the_middle_is_that_of_the_refreshes_between_two_solutions(cost_ns: int, wait_ns: int) -> None:
    composed_ns, photon_ns = 10**9, 10**9 + 25_000_000
    refreshes = np.arange(1, 60)  # later ones than the current refresh
    done_ns = composed_ns + wait_ns + cost_ns
    composed = composed_ns + refreshes * PERIOD_NS
    showing = refreshes[(composed >= done_ns) & (composed < done_ns + cost_ns)]
    if not showing.size:  # the next solution is complete before a refresh, but the request cannot know
        showing = refreshes[composed >= done_ns][:1]
    expected_ns = photon_ns + showing.mean() * PERIOD_NS
    slots = Slots(photon_ns, composed_ns, composed_ns + wait_ns, PERIOD_NS)
    assert abs(slots.middle_ns(cost_ns) - expected_ns) <= 1


@pytest.mark.parametrize(
    ("done", "step_ms", "most", "gets"),
    [
        (Effort(1, 6), 2.0, 8, True),
        (Effort(2, 6), 2.0, 8, False),  # a finer raster comes first
        (Effort(1, 8, focus=True), 2.0, 8, False),
        (Effort(1, 6), 15.0, 8, False),  # 16 steps of 45 ms are more than a quarter of two seconds
        (Effort(1, 6), 2.0, 0, False),  # a model without steps
    ],
)
def test_a_resting_head_s_finished_solution_gets_focus_if_time_allows(
    done: Effort, step_ms: float, most: int, gets: bool
) -> None:
    shown = Solution(1, np.zeros((3, 2, 2, 4), np.uint8), EYES, 0, effort=done)
    costs = Costs({1: {"render": 1.0, "step": step_ms}, 2: {"render": 0.3, "step": 0.5}})
    effort = focused(shown, most, costs, horizon_s=2.0)
    assert effort == (Effort(1, FOCUS_STEPS, focus=True) if gets else None)


def test_focus_costs_the_drawing_of_ten_pictures_and_three_steps_for_one() -> None:
    costs = Costs({1: {"render": 5.0, "step": 2.0, "finish": 1.0}})
    assert costs.ms(Effort(1, 8)) == 5 + 1 + 16
    assert costs.ms(Effort(1, 8, focus=True)) == 25 + 1 + 48
