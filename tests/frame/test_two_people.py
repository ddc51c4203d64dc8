"""Tests of a run for two people: what is solved, aligned, measured and reported for each."""

from __future__ import annotations

import json
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
from runtime.frame.served import accounts_of, matched, moved_m2
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


def test_movement_that_is_not_shared_counts_more() -> None:
    alike, apart = TWO + np.array([0, 0.01, 0]), TWO + np.repeat([[0, 0.01, 0], [0, -0.01, 0]], 2, axis=0)
    assert moved_m2(TWO, apart) > 4 * moved_m2(TWO, alike)
    assert moved_m2(TWO, alike) == pytest.approx(moved_m2(TWO[:2], alike[:2]))


def test_estimates_of_two_people_are_one_of_four_eyes() -> None:
    one, two = estimate((1,), TWO[:2]), estimate((5,), TWO[2:])
    lost = EyesEstimate(0, 0, None, "none")
    assert together([one, two]).people == (1, 5)
    np.testing.assert_array_equal(together([one, two]).eyes_m, TWO)
    assert together([one, lost]) is one and together([lost, lost]) is lost


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
