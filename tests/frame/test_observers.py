"""Several observers of one run."""

from __future__ import annotations

from runtime.frame.presenter import Observers
from tests.frame.fakes import Stage, Watching


def test_each_is_told_everything_in_order() -> None:
    first, second = Watching(), Watching()
    stage = Stage()
    both = Observers(first, second)
    refreshes = stage.refresh(3)
    for refresh in refreshes:
        both.refreshed(refresh)
    for sample in stage.watching.samples:
        both.sampled(sample)
    assert first.refreshes == second.refreshes == refreshes
    assert first.samples == second.samples == stage.watching.samples != []
