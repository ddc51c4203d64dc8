"""A short soak with every fault in it; the long one is `make soak`."""

from __future__ import annotations

from tests.soak import soak


def test_nothing_piles_up_while_parts_are_lost_and_come_back():
    result = soak(400, warm=200, fault_every=100)
    assert result.frames >= 400
    assert result.faults["panel"] >= 4
    assert result.presented < result.frames
    assert result.problems() == []
