"""A short operator's hour with every fault and change in it; the long one is `make soak`."""

from __future__ import annotations

import pytest

from tests.soak import soak


@pytest.mark.slow
def test_nothing_piles_up_is_lost_or_told_wrongly_while_parts_are_lost_and_changed() -> None:
    soak(1, warm=2, growth_max=0.03)  # so early, allocators still grow: `make soak` allows 1%
