"""Tests of a run for two people: what is solved, aligned, measured and reported for each."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.config import Settings
from runtime.daemon.build import RunOptions
from runtime.daemon.drive import drive
from runtime.evaluation.motion_recording import write_motion
from runtime.frame.served import accounts_of, matched, moved_m2, sigma_factor
from runtime.frame.viewer import together
from runtime.optics.alignment import align, common_movement_m
from runtime.optics.stack import PanelStack
from runtime.records import F64, EyesEstimate, Solution

STACK = PanelStack(0.5184, 0.2916, (-0.09, -0.03, 0.03, 0.09), 192, 108)
COSTS = {"sensor": 0.1, "track": 0.1, "render": 1, "prepare": 2, "inference": 0, "finish": 1, "step": 1, "present": 1}


def eyes_at(*places: tuple[float, float, float]) -> F64:
    return np.concatenate([np.array([place]) + np.array([[0, -0.03, 0], [0, 0.03, 0]]) for place in places])


TWO = eyes_at((0.62, -0.2, 0.0), (0.66, 0.2, 0.0))


def solution(people: tuple[int, ...], eyes_m: F64) -> Solution:
    layers = np.zeros((4, 2, 2, 4), np.uint8)
    return Solution(1, layers, eyes_m, 0, people=people, seeing=(True,) * len(eyes_m))


def estimate(people: tuple[int, ...], eyes_m: F64) -> EyesEstimate:
    return EyesEstimate(0, 0, eyes_m, "predicted", 0.001, people)


steps = st.tuples(*[st.floats(-0.1, 0.1)] * 3)


@given(steps, steps)
def test_the_shared_movement_never_exceeds_what_either_person_has_moved(first: Any, second: Any) -> None:
    moved = TWO + np.repeat(np.array([first, second]), 2, axis=0)
    common = common_movement_m(TWO, moved)
    for step in (first, second):
        assert (np.abs(common) <= np.abs(step) + 1e-12).all() and (common * np.array(step) >= -1e-12).all()


def test_a_person_at_rest_keeps_the_layers_where_they_are() -> None:
    moved = TWO + np.repeat([[0.0, 0.0, 0.0], [0.0, 0.05, 0.01]], 2, axis=0)
    for matrix in align(STACK, solved_for_m=TWO, eyes_m=moved).solved_from_shown:
        np.testing.assert_array_equal(matrix, np.eye(3))


def test_layers_follow_two_people_who_move_alike() -> None:
    moved = TWO + np.array([0.0, 0.02, 0.0])
    shared = align(STACK, solved_for_m=TWO, eyes_m=moved).solved_from_shown
    alone = align(STACK, solved_for_m=TWO[:2], eyes_m=moved[:2]).solved_from_shown
    for both, one in zip(shared, alone, strict=True):
        np.testing.assert_allclose(both, one, atol=0.5)  # pixels; the two are at different distances


def test_one_person_of_two_is_aligned_exactly_once_the_other_has_left() -> None:
    moved = TWO[2:] + np.array([0.0, 0.03, 0.0])
    solved_for_m, eyes_m = matched(solution((1, 2), TWO), estimate((2,), moved))
    np.testing.assert_array_equal(solved_for_m, TWO[2:])
    np.testing.assert_array_equal(eyes_m, moved)


def test_a_new_person_does_not_move_the_picture_of_the_first() -> None:
    solved_for_m, eyes_m = matched(solution((1,), TWO[:2]), estimate((1, 2), TWO))
    np.testing.assert_array_equal(solved_for_m, eyes_m)
    first, second = accounts_of(solution((1,), TWO[:2]), estimate((1, 2), TWO))
    assert first.solved_for_m is not None and second.solved_for_m is None and second.number == 2


@pytest.mark.parametrize(
    ("numbers", "solved_for", "now"),
    [
        ((3, 1), (0, 2), (1, 0)),  # each where they are in either; the one who has left is left out
        ((7, 8), (0,), (0,)),  # nobody it was computed for: the first ones
    ],
)
def test_the_same_people_are_compared_wherever_they_are_listed(
    numbers: tuple[int, ...], solved_for: tuple[int, ...], now: tuple[int, ...]
) -> None:
    three, present = eyes_at((0.6, -0.2, 0.0), (0.6, 0.0, 0.0), (0.6, 0.2, 0.0)), TWO + np.array([0.0, 0.0, 0.1])
    solved_for_m, eyes_m = matched(solution((1, 2, 3), three), estimate(numbers, present))
    np.testing.assert_array_equal(solved_for_m, np.concatenate([three[2 * n : 2 * n + 2] for n in solved_for]))
    np.testing.assert_array_equal(eyes_m, np.concatenate([present[2 * n : 2 * n + 2] for n in now]))


def test_an_eye_that_sees_nothing_is_replaced_by_its_person_s_other() -> None:
    one_eyed = replace(solution((1, 2), TWO), seeing=(True, True, True, False))
    np.testing.assert_array_equal(matched(one_eyed, estimate((2,), TWO[2:]))[1], TWO[[2, 2]])
    np.testing.assert_array_equal(matched(one_eyed, estimate((1, 2), TWO))[1], TWO[[0, 1, 2, 2]])


@pytest.mark.parametrize(
    ("first_mm", "second_mm", "expected_mm2"),
    [
        ((3, 4, 12), None, 169),
        ((0, 10, 0), (0, 10, 0), 100),
        ((0, 10, 0), (0, -10, 0), 900),  # each has moved 100, and shares none of it, which counts eight times more
        ((0, 10, 0), (0, 30, 0), 2100),  # 100 and 900, and eight times 400
    ],
)
def test_movement_that_is_not_shared_counts_more(first_mm: Any, second_mm: Any, expected_mm2: float) -> None:
    moved_mm = [first_mm] if second_mm is None else [first_mm, second_mm]
    before_m = TWO[: 2 * len(moved_mm)]
    found_m2 = moved_m2(before_m, before_m + np.repeat(np.array(moved_mm) / 1e3, 2, axis=0))
    assert found_m2 == pytest.approx(expected_mm2 / 1e6)
    assert [sigma_factor(people) for people in (0, 1, 2, 3)] == pytest.approx([1.0, 1.0, 3.0, 3.0])


def test_accounts_name_the_eyes_that_each_person_s_picture_is_for() -> None:
    assert accounts_of(solution((1,), TWO[:2]), EyesEstimate(0, 0, None, "none")) == ()
    (only,) = accounts_of(None, estimate((), TWO[:2]))
    assert (only.number, only.solved_for_m) == (1, None)
    second, first = accounts_of(solution((1, 2), TWO), estimate((2, 1), TWO[[2, 3, 0, 1]]))
    for account, eyes_m in ((first, TWO[:2]), (second, TWO[2:])):
        np.testing.assert_array_equal(account.eyes_m, eyes_m)
        np.testing.assert_array_equal(account.solved_for_m, eyes_m)
    newer, other = accounts_of(solution((1, 2), TWO), estimate((7, 8), TWO))  # the first is shown another's picture
    np.testing.assert_array_equal(newer.solved_for_m, TWO[:2])
    assert other.solved_for_m is None


def test_estimates_of_two_people_are_one_of_four_eyes() -> None:
    one, two = estimate((1,), TWO[:2]), estimate((5,), TWO[2:])
    lost = EyesEstimate(0, 0, None, "none")
    assert together([one, two]).people == (1, 5)
    np.testing.assert_array_equal(together([one, two]).eyes_m, TWO)
    assert together([one, lost]) is one and together([lost, lost]) is lost
    held = EyesEstimate(5, 4, TWO[2:], "held", 0.007, (5,))
    assert [together([one, two]).label, together([one, held]).label] == ["predicted", "predicted"]
    assert together([held, held]).label == "held"
    both = together([held, one, lost])
    assert (both.time_ns, both.capture_ns) == (5, 4) and both.sigma_m == pytest.approx(0.005), "RMS of 7 and 1 mm"


def run(folder: Path, motion: str, *, panels: int, seconds: float, **tables: Any) -> tuple[dict[str, Any], list[Any]]:
    write_motion(folder / "two.mcap", motion, seconds=seconds, noise_mm=1.0)
    x_m = [round(0.06 * (n - (panels - 1) / 2), 3) for n in range(panels)]
    settings = {
        "stack": {"x_m": x_m, "width_px": 192, "height_px": 108},
        "sensor": {"driver": "replay", "source": str(folder / "two.mcap")},
        "loop": {"simulated_stage_ms": COSTS, "evaluate_every": 20},
        "tracker": {"join_s": 0.2},
        **tables,
    }
    drive(
        Settings.model_validate(settings), RunOptions(max_speed=True, measure=True, out=folder / "out", keep_light=59)
    )
    lines = [json.loads(line) for line in (folder / "out" / "frames.jsonl").read_text().splitlines()]
    return json.loads((folder / "out" / "summary.json").read_text()), lines


@pytest.mark.slow
def test_two_people_on_four_panels_each_see_their_own_picture(tmp_path: Path) -> None:
    summary, lines = run(tmp_path, "two-still", panels=4, seconds=1.4)
    known = [line for line in lines if line["true_eyes_m"] is not None and len(line["people"]) == 2]
    last = known[-1]["people"]
    assert len(last) == 2 and {person["number"] for person in last} <= {one["number"] for one in summary["people"]}
    for person in last:
        away_mm = 1e3 * np.abs(np.array(person["eyes_m"]) - person["true_eyes_m"]).max()
        assert away_mm < 8 and person["solved_for_m"] is not None
    assert known[-1]["eyes_m"] == last[0]["eyes_m"]
    assert not any(line["state"] in ("flat", "holding") for line in lines[10:])  # no dark refresh when one joins
    kept = sorted((tmp_path / "out" / "light").iterdir())[-1]
    names = {f"{kind}-{eye}.png" for kind in ("drawn", "true") for eye in ("left", "right", "left-2", "right-2")}
    assert names <= {path.name for path in kept.iterdir()}
    assert len(json.loads((kept / "light.json").read_text())["people"]) == 2


@pytest.mark.slow
def test_three_panels_serve_the_first_of_two_people(tmp_path: Path) -> None:
    summary, lines = run(tmp_path, "two-still", panels=3, seconds=0.8)
    assert max(len(line["people"]) for line in lines) == 1 and len(summary["people"]) <= 2
