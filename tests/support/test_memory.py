"""What there is when a run begins is not looked through for garbage while it lasts."""

from __future__ import annotations

import gc

from runtime.support.memory import settled


def test_what_there_was_before_is_not_looked_through_and_what_came_since_is() -> None:
    there = [[number] for number in range(10_000)]
    with settled():
        assert gc.get_freeze_count() > len(there)
        made = [[number] for number in range(1000)]
        looked_through = gc.get_objects()
        assert len(made) <= len(looked_through) < len(there)
    assert gc.get_freeze_count() == 0
