"""Tests that recordings of any rate, with gaps, play once and at their times."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.clock import NS_PER_S, MonotonicClock, SimulatedClock
from runtime.config import SensorSettings
from runtime.errors import InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.live import SensorSetup, SensorThread
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader
from runtime.sensor.replay import ReplayDriver
from runtime.support.untrusted_input import LIMITS
from tests.sensor.taken import taken_until

HEADER = RecordingHeader(driver="test", serial="S")
RATE_HZ = 240
EYES = EyePoints(np.array([[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]), np.ones(2))


def recorded(path: Path, times_s: Any) -> Path:
    with recording_to(path, HEADER) as writer:
        for k, t in enumerate(times_s, start=1):
            assert writer.write(SensorFrame(k, round(t * NS_PER_S), EYES))
    return path


def evenly(rate_hz: int, seconds: float, start_s: float = 1.0) -> NDArray[np.float64]:
    return start_s + np.arange(round(rate_hz * seconds)) / rate_hz


def play(
    path: Path, *, timeout_s: float = 0.1, latency_ms: float = 0.0, busy_s: float = 0.002, at_most_s: float = 8.0
) -> tuple[list[tuple[SensorFrame, int]], set[str], SensorThread]:
    """Every sample that a worker hands out, with the time at which the reader got it, and the worker."""
    clock = MonotonicClock()
    settings = SensorSettings(timeout_s=timeout_s)
    worker = SensorThread(SensorSetup(lambda: ReplayDriver(str(path), clock, latency_ms=latency_ms), settings, clock))
    worker.start()
    got, states, end = [], set(), time.monotonic() + at_most_s
    while time.monotonic() < end:
        is_over = worker.state == "ended"
        frames = worker.take()
        got += [(frame, clock.now_ns()) for frame in frames]
        states.add(str(worker.state))
        if is_over and not frames:
            break
        time.sleep(busy_s)
    worker.close()
    return got, states, worker


def test_a_gap_longer_than_the_time_out_reopens_nothing(tmp_path: Path) -> None:
    times = [*evenly(30, 0.5), *evenly(30, 0.5, start_s=2.3)]
    got, states, _ = play(recorded(tmp_path / "gap.mcap", times), latency_ms=20.0)
    assert [frame.sequence for frame, _ in got] == list(range(1, 31))
    assert not states & {"stalled", "lost"}
    arrived = np.array([at for _, at in got]) - got[0][0].capture_ns
    late = (arrived - np.array(times) * NS_PER_S + NS_PER_S) / NS_PER_S - 0.020
    assert late.min() > -1e-3 and np.median(late) < 0.3  # the gap is of eight time-outs


def test_fast_recordings_are_delivered_whole_and_in_order_to_a_slow_reader(tmp_path: Path) -> None:
    path = recorded(tmp_path / "fast.mcap", evenly(RATE_HZ, 0.5))
    got, _, worker = play(path, busy_s=1 / 30)  # a reader that is slower than the recording
    assert [frame.sequence for frame, _ in got] == list(range(1, 1 + round(0.5 * RATE_HZ)))
    assert worker.stale_inputs == 0


def test_samples_whose_time_goes_backwards_are_left_out_and_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    times = [1.0, 1.1, 1.05, 1.1, 1.2, 0.2, 0.3, 1.2, 1.3]
    driver = ReplayDriver(str(recorded(tmp_path / "a.mcap", times)), SimulatedClock())
    driver.open()
    frames = taken_until(driver, 10 * NS_PER_S)
    assert [f.sequence for f in frames] == [1, 2, 5, 9]
    assert len(caplog.records) == 1


def test_a_recording_longer_than_the_limit_is_refused_with_both_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LIMITS, "recording_s", 60)
    driver = ReplayDriver(str(recorded(tmp_path / "a.mcap", [0.0, 1.0, 500.0])), SimulatedClock())
    with pytest.raises(InputError, match=r"500 s.*60"):
        driver.open()
        taken_until(driver, 10**15)
