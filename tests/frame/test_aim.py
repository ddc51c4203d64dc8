"""Tests that a solution is requested for the middle of the refreshes that will show it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runtime.frame.aim import Slots

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
