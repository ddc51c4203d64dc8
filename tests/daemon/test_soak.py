"""A short soak with every fault and change in it; the long one is `make soak`."""

from __future__ import annotations

from tests.soak import soak


def test_nothing_piles_up_and_no_refresh_is_lost_while_parts_are_lost_and_changed() -> None:
    result = soak(1200, warm=400, fault_every=100, change_every=60, least_changes=4)
    assert result.frames >= 1200
    assert result.faults["panel"] >= 4
    assert result.changes >= 4
    assert result.without_a_panel > 0
    assert result.solutions > 0
    assert result.problems(growth_max=0.03) == []  # so early, allocators still grow: `make soak` allows 1%
