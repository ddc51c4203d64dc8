"""A short soak with every fault in it; the long one is `make soak`."""

from __future__ import annotations

from tests.soak import soak


def test_nothing_piles_up_while_parts_are_lost_and_come_back():
    result = soak(320, warm=160, fault_every=80)
    assert result.frames >= 320
    assert result.faults["panel"] >= 4
    assert result.presented < result.frames
    assert result.problems() == []
