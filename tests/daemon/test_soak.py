"""A minute of every fault and change; the long one is `make soak`."""

from __future__ import annotations

import pytest

from tests.soak import soak


@pytest.mark.slow
def test_nothing_piles_up_is_lost_or_gets_no_answer_while_parts_are_lost_and_changed() -> None:
    soak(90.0, growth_mib=200)  # so early, everything still grows
