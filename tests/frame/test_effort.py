"""Tests that moving heads get less work and resting ones more, by measured costs and errors."""

from __future__ import annotations

import math
from itertools import groupby, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.frame.effort import (
    BLUR_M,
    RASTER_ERRORS,
    REST,
    CostBook,
    Costs,
    EffortChooser,
    Foresight,
    Outlook,
    PictureStatistics,
    candidates,
    display_spread_s,
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
    by_steps = [PictureStatistics().own(Effort(1, steps)) for steps in range(10)]
    assert by_steps == sorted(by_steps, reverse=True) and by_steps[8] == by_steps[9] > 0.3 * by_steps[0]


def test_costs_of_the_simulated_clock_follow_the_contract() -> None:
    costs = simulated_costs(STAGE_MS, REDUCTIONS)
    assert costs.ms(Effort(1, 0)) == pytest.approx(153.0)
    assert costs.ms(Effort(1, 4)) == pytest.approx(153.0 + 4 * 85.0)
    assert costs.ms(Effort(2, 1)) == pytest.approx((153.0 + 85.0) / 4)
    assert costs.ms(Effort(4, 0)) == pytest.approx(153.0 / 16)
    assert costs.ms(Effort(1, 6, continued_from=4)) == pytest.approx(38.0 + 2 * 85.0), "nothing is drawn or proposed"


@pytest.mark.parametrize(
    ("effort", "people", "cost_ms"),
    [
        (Effort(1, 0), 1, 5 + 2 + 1 + 4 + 3),
        (Effort(1, 2), 1, 15 + 2 * 10),
        (Effort(1, 5, continued_from=3), 1, 4 + 3 + 2 * 10),
        (Effort(1, 2, focus=True), 1, 15 + 2 * 30 + 4 * 5),  # ten pictures in place of two, and three steps in one
        (Effort(1, 2), 2, 2 * (5 + 2 + 1) + 4 + 3 + 2 * 20),
        (Effort(2, 2), 1, 0),  # unknown
    ],
)
def test_a_solution_costs_its_stages_its_steps_and_its_rest(effort: Effort, people: int, cost_ms: float) -> None:
    stages = {"render": 5.0, "prepare": 2.0, "inference": 1.0, "finish": 4.0, "step": 10.0, REST: 3.0}
    assert Costs({1: stages}).for_people(people).ms(effort) == cost_ms


def test_efforts_to_choose_from_have_no_more_steps_than_the_model() -> None:
    counts = {most: [effort.steps for effort in candidates((2,), most)] for most in (0, 3, 4, 6)}
    assert counts == {0: [0], 3: [0, 1, 2, 3], 4: [0, 1, 2, 4], 6: [0, 1, 2, 4, 6]}
    assert candidates((1, 4), 1) == [Effort(1, 0), Effort(1, 1), Effort(4, 0), Effort(4, 1)]


@pytest.mark.parametrize(("cost_ms", "spread_ms"), [(0.0, 0.0), (10.0, 0.0), (20.0, 5.0), (30.0, 8.165)])
def test_display_times_spread_if_a_solution_is_shown_more_than_once(cost_ms: float, spread_ms: float) -> None:
    """Two refreshes 10 ms apart are 5 ms from their middle."""
    assert display_spread_s(cost_ms, period_ms=10.0) * 1e3 == pytest.approx(spread_ms, abs=1e-3)


def test_deviation_speed_and_lag_add_up_in_squares() -> None:
    assert Outlook(0.001, 2.0, 0.003).moved_m2(0.001) == pytest.approx((2 + 4 + 9) * 1e-6)


@pytest.mark.parametrize(
    ("cost_ms", "horizon_s", "mean"),
    [
        (0.0, 1.0, 0.02),
        (500.0, 1.0, 0.02 + 0.01 + 0.125 * 0.03),
        (500.0, 2.0, 0.01 + 0.015 + 0.03125 * 0.03),
        (3000.0, 1.0, 0.036 + 0.002 + 0.405 * 0.03),  # nine tenths of the horizon at most
    ],
)
def test_an_error_is_averaged_with_the_shown_one_until_completion(
    cost_ms: float, horizon_s: float, mean: float
) -> None:
    chooser = EffortChooser()
    found = chooser.mean_error(0.02, cost_ms, shown_error=0.04, horizon_s=horizon_s)
    assert found == pytest.approx(mean), "and with the contrast, for a head that starts moving"


def test_an_expected_error_is_the_solution_s_and_a_stale_view_s() -> None:
    chooser = EffortChooser()
    chooser.foresight.learn(expected_m2=4e-6, found_m2=1e-6)  # predictions are twice as good as expected
    moving = Outlook(speed_m_s=1.0, lag_m=0.008)
    expected = chooser.pictures.own(Effort(2, 1)) + chooser.pictures.stale(0.004, 0.0)
    assert chooser.expected_error(Effort(2, 1), moving, spread_s=0.0) == pytest.approx(expected)
    chooser.pictures.rate_s2 = 0.4
    expected = chooser.pictures.own(Effort(2, 1)) + chooser.pictures.stale(0.005, 0.006)
    assert chooser.expected_error(Effort(2, 1), moving, spread_s=0.006) == pytest.approx(expected), "6 mm and 8 mm"


@pytest.mark.parametrize(
    ("before", "full", "half", "chosen"),
    [
        (None, 1.00, 1.04, 2),  # the faster of two that are nearly equal
        (None, 1.00, 1.06, 1),
        (2, 0.93, 1.00, 2),  # not enough better for a change to the slower one
        (2, 0.91, 1.00, 1),
        (1, 1.00, 1.04, 2),  # a faster one is taken at once
        (4, 0.93, 1.00, 1),  # what was chosen before is no longer offered
    ],
)
def test_a_slower_effort_has_to_be_clearly_better(before: int | None, full: float, half: float, chosen: int) -> None:
    chooser = EffortChooser()

    def choice(*errors: tuple[int, float]) -> int:
        chooser.pictures.learn(Measures(residual=0.0, detail={by: 1e-3 * error for by, error in errors}), Effort())
        efforts, costs = [Effort(by, 0) for by, _ in errors], Costs({by: {"render": 8.0 / by} for by in (1, 2, 4)})
        picked = chooser.choose(
            efforts, costs, lambda _: Outlook(), shown_error=0.0, period_ms=PERIOD_MS, horizon_s=1e9
        )
        return picked.reduction

    assert before is None or choice((before, 1.0)) == before
    assert choice((1, full), (2, half)) == chosen


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


@pytest.mark.parametrize(
    ("distance_m", "elapsed_s", "error"),
    [(0.0, 0.0, 0.0), (0.004, 0.0, 9.88e-4), (0.0, 0.1, 4.386e-3), (0.004, 0.1, 5.12e-3), (10.0, 0.0, 0.1298)],
)
def test_a_stale_view_s_error_grows_to_the_contrast_and_beyond(
    distance_m: float, elapsed_s: float, error: float
) -> None:
    pictures = PictureStatistics(rate_m=0.5, rate_s2=0.5, contrast=0.03)
    assert pictures.stale(distance_m, elapsed_s) == pytest.approx(error, rel=1e-3)


def test_a_change_beyond_the_contrast_counts_ten_times_at_most() -> None:
    pictures = PictureStatistics(contrast=0.03)
    for _ in range(200):
        pictures.learn(Measures(change=(0.06, 0.004, 0.0)), Effort())
    assert pictures.rate_m == pytest.approx(0.6 / 0.002, rel=0.01)


def test_pictures_that_never_change_have_no_negative_rates() -> None:
    pictures = PictureStatistics(rate_s2=1.0)
    for _ in range(300):
        pictures.learn(Measures(change=(0.0, 0.02, 0.02), contrast=0.0), Effort())
        pictures.learn(Measures(change=(0.0, 0.0, 0.2)), Effort())
    assert pictures.rate_s2 == 0.0 and 0.0 < pictures.rate_m < 0.01
    assert 0.0 < pictures.contrast < 0.001, "uniform pictures"
    for _ in range(300):
        pictures.learn(Measures(change=(0.0, 0.0, 0.0)), Effort())
    assert pictures.rate_s2 == 0.0, "eyes and time that stand still teach nothing"


def test_a_residual_counts_for_the_steps_that_it_had() -> None:
    pictures = PictureStatistics()
    pictures.learn(Measures(change=(0.0, 0.0, 0.0), detail={2: 5e-4}), Effort())  # no residual yet
    pictures.learn(Measures(residual=2e-3), Effort(1, 2))
    assert pictures.own(Effort(1, 2)) == pytest.approx(2e-3), "the first measurement replaces the initial estimate"
    assert pictures.own(Effort(1, 0)) > pictures.own(Effort(1, 4))
    pictures.learn(Measures(residual=1e-3), Effort(1, 2))
    assert pictures.own(Effort(1, 2)) == pytest.approx(1.8e-3), "later ones change it by a fifth"
    pictures.learn(Measures(residual=0.0, detail={3: 7e-4}), Effort())
    assert pictures.own(Effort(3, 0)) - pictures.own(Effort(2, 0)) > 2e-4 and pictures.detail[2] == 5e-4


def test_a_coarse_solutions_residual_tells_little_of_the_full_rasters() -> None:
    """The first solution is coarse; its residual would make steps on a coarse raster seem better than a finer one."""
    pictures = PictureStatistics()
    pictures.learn(Measures(residual=3e-3), Effort(4, 0))
    assert pictures.own(Effort(4, 0)) == pytest.approx(pictures.detail[4] + 3e-3)
    assert pictures.own(Effort(1, 0)) < pictures.own(Effort(2, 2)) - pictures.detail[2]


@pytest.mark.parametrize(("found_m2", "scale"), [(1e-6, 0.25), (8e-6, 2.0), (0.0, 0.02), (1e-3, 4.0)])
def test_displacements_are_scaled_to_those_that_come_to_pass(found_m2: float, scale: float) -> None:
    foresight = Foresight()
    foresight.learn(expected_m2=0.0, found_m2=1.0)
    assert foresight.scale == 1.0
    for _ in range(300):
        foresight.learn(expected_m2=4e-6, found_m2=found_m2)
    assert foresight.scale == pytest.approx(scale, rel=0.01)


def test_a_second_of_other_displacements_counts_for_two_thirds() -> None:
    foresight = Foresight()
    for ratio, refreshes in ((1, 600), (3, 60)):
        for _ in range(refreshes):
            foresight.learn(expected_m2=1e-6, found_m2=ratio * 1e-6)
    assert foresight.scale == pytest.approx(1 + 2 * 0.635, abs=0.02)


def test_a_single_jump_hardly_changes_what_the_predictions_are_worth() -> None:
    foresight = Foresight()
    for _ in range(300):
        foresight.learn(expected_m2=4e-6, found_m2=4e-6)
    foresight.learn(expected_m2=4e-6, found_m2=0.1**2)  # one sample was mistaken by 10 cm
    assert foresight.scale == pytest.approx(1.25, abs=0.01), "sixteen times as far as expected, at most"


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


def test_measured_times_change_by_a_fifth_and_those_not_measured_in_proportion() -> None:
    book = CostBook({1: {"render": 100.0, "finish": 50.0, "step": 10.0}, 2: {"render": 25.0}})
    book.learn(Effort(2, 0), {"render": 25.0})
    book.learn(Effort(1, 8, focus=True), {"render": 900.0})
    book.learn(Effort(1, 2), {"render": 100.0, "finish": 50.0, "step": 40.0})
    assert dict(book.costs().stages[1]) == pytest.approx(
        {"render": 100.0, "finish": 50.0, "step": 12.0, "prepare": 0.0, "inference": 0.0, REST: 0.0}
    )
    book.learn(Effort(1, 0), {"render": 250.0, "finish": 50.0})  # 130 in place of 100: a fifth slower altogether
    assert book.costs().stages[1]["render"] == pytest.approx(130.0)
    assert book.costs().stages[1]["step"] == pytest.approx(12.0 * 180 / 150)
    slower = (162 / 160) ** 0.8 * (180 / 150) ** 0.8  # other work on the machine explains most of it
    assert book.costs().stages[2]["render"] == pytest.approx(25.0 * slower)


def test_time_that_belongs_to_no_stage_is_the_latest_solution_s() -> None:
    book = CostBook({by: {"render": 100.0 / by**2} for by in (1, 2, 4)})
    book.learn(Effort(1, 0), {"render": 100.0, REST: 10.0})
    book.learn(Effort(2, 0), {"render": 25.0, REST: 15.0})
    assert [book.costs().stages[by][REST] for by in (2, 4)] == pytest.approx([11.0, 11.0])


def test_costs_without_any_times_are_nothing() -> None:
    nothing: dict[int, dict[str, float]] = {1: {}}
    for first in (nothing, {1: {"render": 0.0}, 2: {"render": 0.0}}):
        book = CostBook(first)
        book.learn(Effort(1, 0), {})
        assert book.costs().ms(Effort(1, 0)) == book.costs().ms(Effort(2, 0)) == 0.0


def test_times_of_a_raster_unused_for_a_hundred_solutions_are_forgotten() -> None:
    book = CostBook({by: {"render": 100.0 / by**2} for by in REDUCTIONS})
    for _ in range(80):  # a raster that is slow for itself
        book.learn(Effort(2, 0), {"render": 25.0})
        book.learn(Effort(3, 0), {"render": 50.0})
    for _ in range(99):
        assert book.costs().ms(Effort(3, 0)) == pytest.approx(50.0, rel=0.1)
        book.learn(Effort(2, 0), {"render": 25.0})
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
