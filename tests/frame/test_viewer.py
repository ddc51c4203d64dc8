"""Tests the eyes at any time, fixed for a resting head and absent where the display is invisible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.config import Settings
from runtime.eyes.calibration import load_calibration
from runtime.frame.viewer import Viewer
from runtime.records import EyePoints, EyesEstimate, SensorFrame
from tests.frame.fakes import EYES, aside

SENSOR_HZ, DISPLAY_HZ = 30, 60
FRONT_M = 0.06
LATENCY_NS = 15 * NS_PER_MS


def viewer(**tables: dict[str, Any]) -> Viewer:
    return Viewer(Settings.model_validate(tables), load_calibration(None), front_m=FRONT_M, in_stack_frame=True)


def watched(
    seen: Viewer,
    seconds: float,
    *,
    noise_m: float,
    y_m: Callable[[float], float] = lambda _: 0.0,
    lost: Callable[[float], bool] = lambda _: False,
    look: Callable[[Viewer], None] = lambda _: None,
) -> list[EyesEstimate]:
    """Estimates at every refresh of a display, from a noisy sensor."""
    random, estimates, number = np.random.default_rng(5), [], 0
    for refresh in range(round(seconds * DISPLAY_HZ)):
        now_ns = NS_PER_S + refresh * NS_PER_S // DISPLAY_HZ
        while (capture_ns := NS_PER_S + number * NS_PER_S // SENSOR_HZ) + LATENCY_NS <= now_ns:
            time_s = number / SENSOR_HZ
            points = EyePoints(aside(y_m(time_s)) + random.normal(0.0, noise_m, (2, 3)), np.ones(2))
            seen.take(SensorFrame(number, capture_ns, None if lost(time_s) else points), serial="F-1")
            number += 1
        look(seen)
        estimates.append(seen.at(now_ns + 10 * NS_PER_MS))
    return estimates


@pytest.mark.parametrize("noise_mm", [0.0, 1.0, 3.0])
def test_a_resting_head_s_eyes_stay_identical_whatever_the_noise(noise_mm: float) -> None:
    told = watched(viewer(), 6.0, noise_m=noise_mm / 1000)[2 * DISPLAY_HZ :]
    assert {estimate.label for estimate in told} == {"rested"}
    assert len({estimate.eyes_m.tobytes() for estimate in told}) == 1
    assert np.abs(told[0].eyes_m - EYES)[:, 1:].max() <= 0.002
    assert all(0.0 < estimate.sigma_m < 0.003 for estimate in told)


def test_a_moving_head_is_predicted_differently_at_every_refresh() -> None:
    told = watched(viewer(), 3.0, noise_m=0.003, y_m=lambda s: 0.1 * np.sin(2 * s))[DISPLAY_HZ:]
    assert {estimate.label for estimate in told} == {"predicted"}
    assert all((a.eyes_m != b.eyes_m).any() for a, b in pairwise(told))


def test_where_the_plan_forbids_rest_every_refresh_is_predicted() -> None:
    told = watched(viewer(plan={"enabled": False}), 3.0, noise_m=0.003)[2 * DISPLAY_HZ :]
    assert {estimate.label for estimate in told} == {"predicted"}
    assert len({estimate.eyes_m.tobytes() for estimate in told}) == len(told)


def test_eyes_lost_at_rest_are_held_there_and_then_none() -> None:
    seen = viewer(tracker={"hold_s": 0.4})
    told = watched(seen, 3.0, noise_m=0.003, lost=lambda s: s > 2.0)
    held = [estimate for estimate in told if estimate.label == "held"]
    assert held
    assert {estimate.eyes_m.tobytes() for estimate in held} == {told[2 * DISPLAY_HZ - 3].eyes_m.tobytes()}
    assert told[-1].label == "none"
    assert told[-1].eyes_m is None


@pytest.mark.parametrize(("x_m", "is_seen"), [(0.0701, True), (0.0699, False), (0.0, False), (-0.5, False)])
def test_eyes_behind_or_in_the_panels_are_none_counted_by_reason(x_m: float, is_seen: bool) -> None:
    """Or a centimetre in front of them."""
    seen = viewer()
    for number in range(5):
        place = aside(x_m=x_m - EYES[0, 0])
        seen.take(SensorFrame(number, NS_PER_S + number * NS_PER_S // 30, EyePoints(place, np.ones(2))), serial="")
        told = seen.at(NS_PER_S + number * NS_PER_S // 30 + NS_PER_MS)
        assert (told.label == "none") != is_seen
        assert (told.eyes_m is not None, told.people, seen.in_view) == ((True, (1,), 1) if is_seen else (False, (), 0))
    assert seen.refused == ({} if is_seen else {"not in front of the panels": 5})


def test_eyes_that_are_expected_within_the_panels_are_none() -> None:
    """A head comes nearer at a metre per second, 3 cm before the panels."""
    seen = viewer(plan={"enabled": False})
    for number in range(10):
        eyes = EyePoints(aside(x_m=0.09 + 0.03 * (9 - number) - EYES[0, 0]), np.ones(2))
        seen.take(SensorFrame(number, NS_PER_S + number * 30 * NS_PER_MS, eyes), serial="")
    newest_ns = NS_PER_S + 9 * 30 * NS_PER_MS
    near, nearer = (seen.ahead(newest_ns + ahead_ms * NS_PER_MS) for ahead_ms in (10, 35))
    assert near.eyes_m is not None and (nearer.eyes_m, nearer.label) == (None, "none")


@pytest.mark.parametrize(
    ("captures_ms", "rate_hz"),
    [
        ([], None),
        ([100], None),
        ([100, 100], None),
        ([100, 90], None),
        ([0, 100, 150], 13.33),
        ([0, *range(1000, 1640, 10)], 100.0),
    ],
)
def test_the_rate_is_that_of_the_latest_64_samples(captures_ms: list[int], rate_hz: float | None) -> None:
    seen = viewer()
    for number, capture_ms in enumerate(captures_ms):
        seen.take(SensorFrame(number, capture_ms * NS_PER_MS, None), serial="")
    assert seen.rate_hz == rate_hz


def test_a_calibration_of_another_sensor_is_warned_of_once(caplog: pytest.LogCaptureFixture) -> None:
    calibration = load_calibration(None)
    calibration = replace(calibration, file=calibration.file.model_copy(update={"sensor_serial": "A-1"}))
    seen = Viewer(Settings(), calibration, front_m=FRONT_M, in_stack_frame=True)
    for number, serial in enumerate(("", "F-1", "F-1")):
        seen.take(SensorFrame(number, number, None), serial=serial)
        assert caplog.text.count("A-1") == (serial != "")


def test_two_viewers_of_three_panels_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    for viewers, warnings in ((1, 0), (2, 1)):
        viewer(tracker={"viewers": viewers})
        assert caplog.text.count("tracker.viewers: while 3 panels serve two people") == warnings


def test_looking_ahead_for_the_solver_changes_nothing_of_what_is_shown() -> None:
    """Eyes return after a loss: they fade from where they were *shown* last, however far ahead the solver asked."""
    story: dict[str, Any] = {
        "noise_m": 0.001, "y_m": lambda s: 0.2 * np.sin(3 * s), "lost": lambda s: 1.0 < s < 1.3,
    }  # fmt: skip
    plain = watched(viewer(), 3.0, **story)
    asked = watched(viewer(), 3.0, **story, look=lambda seen: [seen.ahead(t * NS_PER_S // 100) for t in (250, 900)])
    for one, other in zip(plain, asked, strict=True):
        assert one.label == other.label
        assert one.eyes_m is None or (one.eyes_m == other.eyes_m).all()


def test_the_tracker_is_reset_only_by_its_own_settings() -> None:
    seen = viewer()
    assert watched(seen, 3.0, noise_m=0.001)[-1].label == "rested"
    calibration = load_calibration(None)
    seen.adopt(Settings.model_validate({"plan": {"enabled": False}}), calibration)
    assert seen.at(4 * NS_PER_S).eyes_m is not None and seen.at(4 * NS_PER_S).label == "predicted"
    seen.adopt(Settings.model_validate({"plan": {"enabled": False}, "tracker": {"hold_s": 2.0}}), calibration)
    assert seen.at(4 * NS_PER_S).eyes_m is None


def test_samples_of_a_sensor_in_its_own_frame_go_through_the_calibration() -> None:
    calibration = load_calibration(None)
    seen = Viewer(Settings(), calibration, front_m=FRONT_M)
    sensor_m = (np.linalg.inv(calibration.stack_from_sensor) @ np.c_[EYES, np.ones(2)].T).T[:, :3]
    seen.take(SensorFrame(0, NS_PER_S, EyePoints(sensor_m, np.ones(2))), serial="demo")
    assert seen.at(NS_PER_S).eyes_m == pytest.approx(EYES, abs=1e-9)
