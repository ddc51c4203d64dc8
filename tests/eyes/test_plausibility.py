"""Tests that implausible eyes are counted and reported with the likely mistake."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.eyes import plausibility as p
from runtime.eyes.motions import MOTIONS, path_of, true_eyes

EYES, PLACE = np.array([[0.6, -0.031, 0.02], [0.6, 0.031, 0.02]]), (0.6, 0.0, 0.02)

WRONG = {
    p.EXCHANGED: EYES[::-1],
    p.MILLIMETRES: EYES * 1000,
    p.BEHIND: EYES * [-1, 1, 1],
    p.TOO_DISTANT: EYES + np.array([30, 0, 0]),
    p.TOO_CLOSE: EYES * [1, 0.1, 1],
    p.TOO_FAR_APART: EYES * [1, 3, 1],
    p.NOT_A_NUMBER: EYES * np.nan,
}


@pytest.mark.parametrize("reason", WRONG)
def test_each_mistake_is_told_by_its_name(reason: str) -> None:
    assert p.reason_against(WRONG[reason]) == reason


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("seed", range(4))
def test_no_moving_viewer_is_suspected_but_exchanged_eyes_are(motion: str, seed: int) -> None:
    for eyes in true_eyes(motion, np.arange(0, 20, 0.05), path=path_of(seed)):
        assert p.reason_against(eyes) == ""
        assert p.reason_against(eyes[::-1]) == p.EXCHANGED


@given(st.floats(-80, 80), st.floats(-0.5, 0.5), st.floats(0.3, 10), st.floats(-90, 90))
def test_heads_that_are_rolled_up_to_a_right_angle_are_a_persons(
    azimuth_deg: float, height_m: float, distance_m: float, roll_deg: float
) -> None:
    azimuth, roll = np.deg2rad(azimuth_deg), np.deg2rad(roll_deg)
    middle = np.array([distance_m * np.cos(azimuth), distance_m * np.sin(azimuth), height_m])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0]) * np.cos(roll) + np.array([0, 0, 1]) * np.sin(roll)
    assert p.reason_against(np.stack([middle - 0.031 * right, middle + 0.031 * right])) == ""


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=6, max_size=6))
def test_any_six_numbers_are_judged(numbers: list[float]) -> None:
    assert isinstance(p.reason_against(np.array(numbers).reshape(2, 3)), str)


def test_the_watch_tells_once_counts_by_reason_and_takes_it_back() -> None:
    watch = p.RefusalWatch()
    told = [watch.update(p.EXCHANGED) for _ in range(100)]
    assert [line for line in told if line] == [watch.warning] and "left and right swapped" in watch.warning
    assert watch.counts == {p.EXCHANGED: 100}
    told = [watch.update("") for _ in range(100)]
    assert [line for line in told if line] == ["sensor: the eyes are plausible again"] and watch.warning == ""
    assert told[22] != ""  # below a quarter: 7 of the last 30 are left


@pytest.mark.parametrize("reasons", [(p.MILLIMETRES, "", "", "", ""), ("uncertain",), ("not where the viewer is", "")])
def test_a_few_bad_samples_are_counted_and_are_no_fault(reasons: tuple[str, ...]) -> None:
    watch = p.RefusalWatch()
    assert not any([watch.update(reasons[k % len(reasons)]) for k in range(200)])
    assert watch.counts == {reasons[0]: 200 // len(reasons)} and watch.warning == ""


@pytest.mark.parametrize("eye", [0, 1])
@pytest.mark.parametrize(("x_m", "reason"), [(0.059, p.BEHIND), (0.06, p.BEHIND), (0.061, "")])
def test_each_eye_must_be_in_front_of_the_front_panel(eye: int, x_m: float, reason: str) -> None:
    eyes = np.array([[0.08, -0.031, 0.02], [0.08, 0.031, 0.02]])
    eyes[eye, 0] = x_m
    assert p.reason_against(eyes, in_front_m=0.06) == reason


@pytest.mark.parametrize(("apart_mm", "place_m", "reason"), [
    (49.9, PLACE, p.TOO_CLOSE), (50.1, PLACE, ""), (78, PLACE, ""), (78.1, PLACE, p.TOO_FAR_APART),
    (62, (20, 0, 0), ""), (62, (20.1, 0, 0), p.TOO_DISTANT), (62, (12, 12, 10.5), ""),
    (62, (12, -12, 10.8), p.TOO_DISTANT),
])  # fmt: skip
def test_eyes_are_50_to_78_mm_apart_within_20_metres(apart_mm: float, place_m: tuple[float, ...], reason: str) -> None:
    assert p.reason_against(EYES * [0, apart_mm / 62, 0] + place_m) == reason


def test_a_mistake_is_told_after_ten_samples_and_in_more_than_half() -> None:
    told = [p.RefusalWatch() for _ in range(2)]
    assert [bool(told[0].update(p.EXCHANGED)) for _ in range(10)] == [False] * 9 + [True]
    half = [told[1].update(reason) for reason in ("", p.EXCHANGED) * 15]
    assert not any(half)
    assert told[1].update(p.EXCHANGED) != ""  # 16 of the last 30


@pytest.mark.parametrize(("reason", "remedy"), [
    (p.MILLIMETRES, "; the driver must deliver metres"), (p.TOO_CLOSE, ""), (p.TOO_FAR_APART, ""),
])  # fmt: skip
def test_a_warning_names_the_mistake_and_its_remedy_if_known(reason: str, remedy: str) -> None:
    watch = p.RefusalWatch()
    told = [watch.update(reason) for _ in range(10)]
    assert told[-1] == watch.warning == f"sensor: the eyes are {reason}{remedy}"
