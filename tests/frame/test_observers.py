"""Several observers of one run."""

from __future__ import annotations

from runtime.frame.observers import Observers
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


def test_who_comes_first_is_told_first() -> None:
    told: list[str] = []

    class Named(Watching):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def refreshed(self, refresh: object) -> None:
            told.append(self.name)

    (refresh,) = Stage().refresh(1)
    Observers(Named("account"), Named("black box")).refreshed(refresh)
    assert told == ["account", "black box"]
