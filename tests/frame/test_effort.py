"""Tests that moving heads get less work and resting ones more, by measured costs and errors."""

from __future__ import annotations

import math
from itertools import groupby, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.frame.effort import (
    BLUR_M,
    KEPT_SOLUTIONS,
    RASTER_ERRORS,
    REST,
    CostBook,
    Costs,
    EffortChooser,
    Foresight,
    Outlook,
    PictureStatistics,
    candidates,
    simulated_costs,
)
from runtime.model.solver import REDUCTIONS
from runtime.records import Effort, Measures

STAGE_MS = {"render": 44.0, "prepare": 40.0, "inference": 31.0, "finish": 38.0, "step": 85.0}
PERIOD_MS = 1000 / 60


def chosen(speed_m_s: float, *, sigma_m: float = 5e-4, slower: float = 1.0, shown_error: float = 5e-3) -> Effort:
    costs = simulated_costs({stage: slower * ms for stage, ms in STAGE_MS.items()}, REDUCTIONS)
    return EffortChooser().choose(
        candidates(REDUCTIONS, 4),
        costs,
        lambda cost_ms: Outlook(sigma_m, speed_m_s, max(cost_ms / 1e3 - 0.1, 0.0) * speed_m_s),
        shown_error=shown_error,
        period_ms=PERIOD_MS,
    )


def test_every_raster_has_errors_that_grow_as_it_gets_coarser() -> None:
    assert tuple(RASTER_ERRORS) == REDUCTIONS
    for values in ([e.share for e in RASTER_ERRORS.values()], [e.first_detail for e in RASTER_ERRORS.values()]):
        assert values == sorted(values)


def test_costs_of_the_simulated_clock_follow_the_contract() -> None:
    costs = simulated_costs(STAGE_MS, REDUCTIONS)
    assert costs.ms(Effort(1, 0)) == pytest.approx(153.0)
    assert costs.ms(Effort(1, 4)) == pytest.approx(153.0 + 4 * 85.0)
    assert costs.ms(Effort(2, 1)) == pytest.approx((153.0 + 85.0) / 4)
    assert costs.ms(Effort(4, 0)) == pytest.approx(153.0 / 16)
    assert costs.ms(Effort(1, 6, continued_from=4)) == pytest.approx(38.0 + 2 * 85.0), "nothing is drawn or proposed"


@given(st.floats(0.0, 2.0), st.floats(0.0, 2.0))
def test_a_faster_head_never_gets_a_longer_solution(one: float, other: float) -> None:
    costs = simulated_costs(STAGE_MS, REDUCTIONS)
    slow, fast = (costs.ms(chosen(speed)) for speed in sorted((one, other)))
    assert fast <= slow


def test_only_a_resting_head_gets_the_full_raster_and_steps() -> None:
    assert chosen(0.0).reduction == 1
    walking = chosen(1.0)
    assert walking.reduction > 1 and walking.steps == 0


def test_on_a_fast_machine_a_moving_head_gets_the_full_raster() -> None:
    assert chosen(0.3, slower=0.02).reduction == 1
    assert chosen(0.3, slower=1.0).reduction > 1


def test_what_is_shown_badly_is_answered_quickly() -> None:
    costs = simulated_costs(STAGE_MS, REDUCTIONS)
    assert costs.ms(chosen(0.0, shown_error=0.05)) < costs.ms(chosen(0.0, shown_error=1e-3))


def test_between_nearly_equal_efforts_the_faster_one_is_kept() -> None:
    """Noise in the head's speed about the point where two efforts are equal does not show as flicker."""
    costs, chooser, picked = simulated_costs(STAGE_MS, REDUCTIONS), EffortChooser(), list[Effort]()
    changes = sorted({speed: chosen(speed) for speed in [k / 500 for k in range(500)]}.items())
    border = next(b[0] for a, b in pairwise(changes) if a[1] != b[1])
    for k in range(50):
        speed = border * (1.0 + 0.02 * math.sin(k))
        picked.append(
            chooser.choose(
                candidates(REDUCTIONS, 4),
                costs,
                lambda cost_ms, speed=speed: Outlook(5e-4, speed, max(cost_ms / 1e3 - 0.1, 0.0) * speed),
                shown_error=5e-3,
                period_ms=PERIOD_MS,
            )
        )
    taken_ms = [costs.ms(effort) for effort, _ in groupby(picked)]
    assert len(taken_ms) <= 2 and taken_ms == sorted(taken_ms, reverse=True)


def test_rates_of_change_are_learned_from_successive_pictures() -> None:
    pictures = PictureStatistics(contrast=0.03)
    for k in range(200):
        moved_m, elapsed_s = 1e-3 * (k % 7), 0.02 * (k % 3)
        y = 0.8 * moved_m**2 / (moved_m + BLUR_M) + 0.4 * elapsed_s**2
        pictures.learn(Measures(change=(y / (1 + y / 0.03), moved_m, elapsed_s)), Effort())
    assert pictures.rate_m == pytest.approx(0.8, rel=0.05)
    assert pictures.rate_s2 == pytest.approx(0.4, rel=0.05)


def test_a_residual_counts_for_the_steps_that_it_had() -> None:
    pictures = PictureStatistics()
    pictures.learn(Measures(residual=1e-3), Effort(1, 2))
    assert pictures.own(Effort(1, 2)) == pytest.approx(1e-3)
    assert pictures.own(Effort(1, 0)) > pictures.own(Effort(1, 4))


def test_a_coarse_solutions_residual_tells_little_of_the_full_rasters() -> None:
    """The first solution is coarse; its residual would make steps on a coarse raster seem better than a finer one."""
    pictures = PictureStatistics()
    pictures.learn(Measures(residual=3e-3), Effort(4, 0))
    assert pictures.own(Effort(4, 0)) == pytest.approx(pictures.detail[4] + 3e-3)
    assert pictures.own(Effort(1, 0)) < pictures.own(Effort(2, 2)) - pictures.detail[2]


def test_displacements_are_scaled_to_those_that_come_to_pass() -> None:
    foresight = Foresight()
    for _ in range(300):
        foresight.learn(expected_m2=4e-6, found_m2=1e-6)
    assert foresight.scale == pytest.approx(0.25, rel=0.01)


def test_a_single_jump_hardly_changes_what_the_predictions_are_worth() -> None:
    foresight = Foresight()
    for _ in range(300):
        foresight.learn(expected_m2=4e-6, found_m2=4e-6)
    foresight.learn(expected_m2=4e-6, found_m2=0.1**2)  # one sample was mistaken by 10 cm
    assert foresight.scale < 1.5


def test_measured_costs_replace_first_ones_and_scale_those_of_other_rasters() -> None:
    first = {by: {stage: ms / by**2 for stage, ms in STAGE_MS.items()} for by in REDUCTIONS}
    book = CostBook(first)
    assert book.costs().ms(Effort(2, 0)) == pytest.approx(153.0 / 4)
    for _ in range(60):  # a sparse scene: a third of the time
        book.learn(Effort(2, 0), {stage: ms / 12 for stage, ms in STAGE_MS.items()})
    costs = book.costs()
    assert costs.ms(Effort(2, 0)) == pytest.approx(153.0 / 12, rel=0.01)
    assert costs.ms(Effort(1, 0)) == pytest.approx(153.0 / 3, rel=0.01)


def test_time_that_belongs_to_no_stage_counts_for_every_raster() -> None:
    book = CostBook({by: {"render": 100.0 / by**2} for by in REDUCTIONS})
    book.learn(Effort(2, 0), {"render": 25.0, REST: 5.0})
    assert book.costs().ms(Effort(2, 0)) == pytest.approx(30.0)
    assert book.costs().ms(Effort(4, 0)) == pytest.approx(100.0 / 16 + 5.0)


def test_a_first_time_that_other_work_delayed_does_not_exclude_a_raster() -> None:
    first = {by: {"render": 100.0 / by**2} for by in REDUCTIONS} | {3: {"render": 90.0}}
    costs = CostBook(first).costs()
    assert costs.ms(Effort(3, 0)) == pytest.approx(25.0 * 2 / 3)
    assert costs.ms(Effort(4, 0)) == pytest.approx(100.0 / 16)


def test_times_of_a_raster_long_unused_are_forgotten() -> None:
    book = CostBook({by: {"render": 100.0 / by**2} for by in REDUCTIONS})
    for _ in range(80):  # a raster that is slow for itself
        book.learn(Effort(2, 0), {"render": 25.0})
        book.learn(Effort(3, 0), {"render": 50.0})
    assert book.costs().ms(Effort(3, 0)) == pytest.approx(50.0, rel=0.1)
    for _ in range(KEPT_SOLUTIONS):
        book.learn(Effort(2, 0), {"render": 25.0})
    assert book.costs().ms(Effort(3, 0)) == pytest.approx(100.0 / 9)


def test_other_work_changes_the_times_of_all_rasters() -> None:
    """Otherwise a raster measured while the machine was busy would be avoided long after."""
    book = CostBook({by: {"render": 100.0 / by**2, "step": 10.0 / by**2} for by in REDUCTIONS})
    for _ in range(40):
        book.learn(Effort(2, 1), {"render": 25.0, "step": 2.5})
    for load in (*[3.0] * 20, *[1.0] * 40):
        book.learn(Effort(4, 0), {"render": 6.25 * load})
        assert book.costs().ms(Effort(2, 0)) == pytest.approx(4 * book.costs().ms(Effort(4, 0)), rel=0.25)
    assert book.costs().ms(Effort(2, 1)) == pytest.approx(27.5, rel=0.01)
    assert book.costs().ms(Effort(4, 1)) == pytest.approx(27.5 / 4, rel=0.01)


def test_the_ratio_between_rasters_is_learned_by_using_both() -> None:
    book = CostBook({by: {"render": 100.0 / by**2} for by in REDUCTIONS})
    for _ in range(60):  # drawing the scene takes as long on every raster
        for reduction in (2, 4):
            book.learn(Effort(reduction, 0), {"render": 25.0})
    costs = book.costs()
    assert costs.ms(Effort(2, 0)) == pytest.approx(costs.ms(Effort(4, 0)), rel=0.15)


def test_a_continued_solution_teaches_nothing_of_drawing() -> None:
    book = CostBook({1: dict(STAGE_MS)})
    book.learn(Effort(1, 6, continued_from=4), {"render": 0.0, "finish": 38.0, "step": 170.0})
    costs: Costs = book.costs()
    assert costs.stages[1]["render"] > 0
    assert costs.stages[1]["step"] == pytest.approx(85.0)
