"""Tests the figures of a run, now and since the start. A figure that was not measured is None."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.frame.stats import Quantiles, RunStats
from runtime.records import RefreshAccount, State

PERIOD_NS = NS_PER_S // 50


def account(number: int, **changes: Any) -> RefreshAccount:
    """Fifty refreshes a second."""
    values: dict[str, Any] = {
        "frame": number, "capture_ns": 1 + number * PERIOD_NS, "predicted_for_ns": 0, "eyes_m": None,
        "present_ns": NS_PER_S + number * PERIOD_NS, "eyes_label": "predicted", "eye_sigma_mm": 2.0,
        "state": State.TRACKING, "solution": 1, "solved_for_m": None, "solution_age_ms": 30.0, "inference": "reused",
        "presented": True, "skew_ms": 0.5, "stage_ms": {"sensor": 0.1, "track": 0.2, "present": 1.0},
    }  # fmt: skip
    values |= changes
    values.setdefault("photon_ns", values["present_ns"] + 8 * NS_PER_MS)
    return RefreshAccount(**values)


def told(accounts: list[RefreshAccount], *, overhead_ms: float = 0.5) -> RunStats:
    stats = RunStats()
    for entry in accounts:
        stats.add(entry, overhead_ms=overhead_ms)
    return stats


def test_refreshes_and_solutions_are_counted_apart() -> None:
    ran = {"inference": "ran", "stage_ms": {"render": 8.0, "inference": 3.0}}
    stats = told([account(k, **(ran if k % 5 == 0 else {})) for k in range(51)])
    summary = stats.summary(stale_inputs=7)
    assert (summary["frames"], summary["presented"], summary["dropped"], summary["stale_inputs"]) == (51, 51, 0, 7)
    assert summary["inferences"] == 11
    assert summary["seconds"] == 1.0
    assert (summary["fps"], summary["solutions_per_s"]) == (50.0, 11.0)
    assert summary["interval_ms"] == {"p50": 20.0, "p99": 20.0}
    assert summary["stage_ms"]["render"] == {"p50": 8.0, "p95": 8.0, "p99": 8.0, "max": 8.0}
    assert summary["solution_age_ms"] == {"p50": 30.0, "p99": 30.0}
    assert summary["eye_sigma_mm"] == {"p50": 2.0, "p99": 2.0}
    # Presented 8 ms before its light, of a capture a second less a nanosecond before.
    assert summary["photon_ms"] == {"p50": 1008.0, "p99": 1008.0}
    assert stats.reuse_saves_ms() == 11.0


def test_display_time_is_counted_by_effort() -> None:
    efforts = [None, "1/2+1", "1/2+1", "1/1+4", None, "1/2+1"]
    summary = told([account(k, effort=effort) for k, effort in enumerate(efforts)]).summary(stale_inputs=0)
    assert summary["efforts"] == {"1/1+4": 0.02, "1/2+1": 0.04}  # the last refresh's has only begun


def test_the_estimated_view_error_starts_from_the_trackers_eyes() -> None:
    eyes_m = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
    moved = [account(k, eyes_m=eyes_m + np.array([0.0, 0.001 * k, 0.0]), solved_for_m=eyes_m) for k in range(101)]
    moved.append(account(101, eyes_m=eyes_m))  # without a solution
    assert told(moved).summary(stale_inputs=0)["view_error_estimated_mm"] == pytest.approx({"p50": 50.0, "p95": 95.0})


def test_what_was_not_measured_is_none() -> None:
    summary = told([]).summary(stale_inputs=0)
    for name in ("fps", "solutions_per_s", "interval_ms", "photon_ms", "overhead_ms", "skew_ms", "solution_age_ms",
                 "efforts", "view_error_estimated_mm"):  # fmt: skip
        assert summary[name] is None, name
    assert set(summary["stage_ms"].values()) == {None}
    assert told([]).rates_now() == {"fps_now": None, "solutions_per_s_now": None}
    assert told([account(0)]).reuse_saves_ms() is None
    alone = told([account(0, capture_ns=0, solution_age_ms=None, eye_sigma_mm=None)]).summary(stale_inputs=0)
    assert (alone["fps"], alone["photon_ms"], alone["solution_age_ms"], alone["eye_sigma_mm"]) == (None,) * 4


def test_a_refresh_without_its_picture_is_dropped_and_splits_the_interval() -> None:
    stats = told([account(k, presented=k != 5) for k in range(11)])
    summary = stats.summary(stale_inputs=0)
    assert (summary["presented"], summary["dropped"]) == (10, 1)
    assert summary["interval_ms"]["p99"] == 20.0  # no interval of 40 ms is invented


def test_panels_that_never_showed_anything_have_a_rate_of_zero() -> None:
    summary = told([account(k, presented=False) for k in range(51)]).summary(stale_inputs=0)
    assert (summary["presented"], summary["dropped"], summary["fps"]) == (0, 51, 0.0)


def test_overhead_leaves_out_the_first_refresh() -> None:
    stats = RunStats()
    stats.add(account(0), overhead_ms=500.0)
    assert stats.summary(stale_inputs=0)["overhead_ms"] is None
    stats.add(account(1), overhead_ms=0.25)
    assert stats.summary(stale_inputs=0)["overhead_ms"] == {"p50": 0.25, "p99": 0.25}


def test_in_simulated_time_every_figure_is_the_run_s_clock_s() -> None:
    stats = told([account(k) for k in range(5)], overhead_ms=123.456)
    assert stats.summary(stale_inputs=0, simulated=True)["overhead_ms"]["p50"] == pytest.approx(0.3)


def test_rates_now_cover_the_last_second_alone() -> None:
    slow = [account(k, present_ns=k * NS_PER_S // 5) for k in range(100)]
    fast = [account(k, present_ns=20 * NS_PER_S + k * PERIOD_NS, inference="ran") for k in range(200)]
    stats = told(slow + fast)
    assert stats.rates_now() == {"fps_now": 50.0, "solutions_per_s_now": 50.0}
    assert stats.summary(stale_inputs=0)["fps"] < 15


def test_quantiles_cover_the_whole_run_and_remember_an_early_stall() -> None:
    """After 8,192 refreshes it was."""
    figures = Quantiles(64)
    for number in range(10_000):
        figures.add(3000.0 if number == 37 else float(number))
        assert figures.of("max")["max"] == max(number, 3000.0 if number >= 37 else 0.0)
    assert figures.of("p50")["p50"] == pytest.approx(5000, rel=0.02)
    assert figures.of("p99")["p99"] == pytest.approx(9900, rel=0.02)


def test_missed_blanks_are_a_total_and_skew_is_of_shown_refreshes() -> None:
    stats = RunStats()
    for number, missed in enumerate([0, 3, 5]):
        stats.add(account(number, skew_ms=float(number), presented=number < 2), overhead_ms=0.1, missed_blanks=missed)
    summary = stats.summary(stale_inputs=0)
    assert summary["missed_blanks"] == 5
    assert summary["skew_ms"] == {"p50": 0.5, "p99": 0.99, "max": 1.0}


@pytest.mark.parametrize("rate_hz", [24, 60, 144, 480])
def test_the_present_rate_is_right_for_slow_and_fast_displays(rate_hz: int) -> None:
    stats = told([account(k, present_ns=round(k * NS_PER_S / rate_hz), inference="ran") for k in range(3 * rate_hz)])
    assert stats.rates_now() == {"fps_now": rate_hz, "solutions_per_s_now": rate_hz}
