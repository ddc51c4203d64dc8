"""A budget is held by giving up quality, and quality comes back when there is long room."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from runtime.plan.levels import PATIENCE, BudgetKeeper, QualityLevel, useful

LADDER = [
    QualityLevel("best", 1.0, 80.0, 44.0),
    QualityLevel("balanced", 1.0, 50.0, 42.0),
    QualityLevel("fast", 0.5, 20.0, 37.0),
]


def run(keeper: BudgetKeeper, slowdown: float, frames: int) -> list[str]:
    labels = []
    for _ in range(frames):
        keeper.frame_took(keeper.level.expected_ms * slowdown)
        labels.append(keeper.level.label)
    return labels


def test_the_best_level_that_fits_is_chosen_at_the_start() -> None:
    assert BudgetKeeper(LADDER, 60).level.model == "balanced"
    assert BudgetKeeper(LADDER, 5).level.model == "fast"
    assert BudgetKeeper(LADDER, 0).level.model == "best"
    assert BudgetKeeper(LADDER, 60).costs_db == 2.0


def test_a_missed_budget_goes_down_and_long_room_goes_up_again() -> None:
    keeper = BudgetKeeper(LADDER, 60)
    assert run(keeper, 1.5, 30)[-1] == "fast at 0.5"
    assert run(keeper, 1.0, PATIENCE - 40)[-1] == "fast at 0.5"
    assert run(keeper, 0.8, 3 * PATIENCE)[-1] == "balanced"


def test_load_between_two_levels_does_not_make_it_swing() -> None:
    keeper = BudgetKeeper(LADDER, 60)
    run(keeper, 1.3, 2000)
    assert keeper.switches == 1


def test_one_slow_frame_changes_nothing() -> None:
    keeper = BudgetKeeper(LADDER, 60)
    for index in range(200):
        keeper.frame_took(500.0 if index % 20 == 0 else 45.0)
    assert keeper.level.model == "balanced"
    assert keeper.switches == 0


@given(st.lists(st.tuples(st.floats(1, 500), st.floats(20, 60)), min_size=1, max_size=8))
def test_no_useful_level_is_slower_and_worse_than_another(values: list[tuple[float, float]]) -> None:
    levels = useful([QualityLevel(str(index), 1.0, time, quality) for index, (time, quality) in enumerate(values)])
    for better, worse in pairwise(levels):
        assert better.psnr_db >= worse.psnr_db
        assert better.expected_ms > worse.expected_ms
    assert max(quality for _, quality in values) == levels[0].psnr_db
