"""Tests that a replayed recording is a sensor, at its pace or sample by sample."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from runtime.clock import NS_PER_S, MonotonicClock, SimulatedClock
from runtime.errors import EndOfRecording, InputError, SensorLost, SensorTimeout
from runtime.records import SensorFrame
from runtime.sensor.recording import Recording
from runtime.sensor.replay import ReplayDriver, demo_recording_path

PERIOD_NS = NS_PER_S / 30


def opened(clock: MonotonicClock | SimulatedClock, **options: float) -> ReplayDriver | None:
    driver = ReplayDriver("demo", clock, **options)
    driver.open()
    return driver


def everything(driver: ReplayDriver, most: int = 10_000) -> list[SensorFrame]:
    frames: list[SensorFrame] = []
    try:
        while len(frames) < most:
            frames.append(driver.next_sample())
    except EndOfRecording:
        pass
    return frames


def test_every_sample_is_delivered_once_in_order_and_without_waiting() -> None:
    clock = SimulatedClock(777)
    driver = opened(clock, latency_ms=15.0)
    frames = everything(driver)
    assert [f.sequence for f in frames] == list(range(1, 301))
    assert frames[0].capture_ns == 777 and clock.now_ns() == 777
    assert driver.available_ns(frames[5]) == frames[5].capture_ns + 15_000_000


def test_replay_keeps_the_timing_and_counts_overtaken_samples() -> None:
    clock = SimulatedClock(NS_PER_S)
    driver = opened(clock, latency_ms=20.0)
    for k in range(20):
        frame = driver.read_newest(0.5)
        assert frame.capture_ns == pytest.approx(NS_PER_S + k * PERIOD_NS, abs=2)
        assert clock.now_ns() == frame.capture_ns + 20_000_000
    clock.advance_ns(round(10.5 * PERIOD_NS))
    assert driver.read_newest(1.0).sequence == 30 and driver.skipped == 9


def test_waiting_ends_with_the_time_out() -> None:
    clock = SimulatedClock()
    driver = opened(clock, latency_ms=500.0)
    with pytest.raises(SensorTimeout):
        driver.read_newest(0.1)
    assert clock.now_ns() == NS_PER_S // 10


def test_a_loop_goes_on_evenly_and_counts_on() -> None:
    frames = everything(opened(SimulatedClock(), loop=True), most=400)
    assert [f.sequence for f in frames] == list(range(1, 401))
    steps = {b.capture_ns - a.capture_ns for a, b in pairwise(frames)}
    assert max(steps) - min(steps) <= 1


def test_an_empty_name_is_refused_with_its_setting() -> None:
    with pytest.raises(InputError, match="sensor: source: is empty"):
        ReplayDriver("", SimulatedClock())


def test_it_can_be_opened_again_and_closed_twice() -> None:
    driver = opened(SimulatedClock())
    everything(driver)
    with pytest.raises(EndOfRecording):
        driver.read_newest(0.1)
    driver.open()
    assert driver.next_sample().sequence == 1
    driver.close()
    driver.close()
    with pytest.raises(SensorLost):
        driver.next_sample()


FRAMES = list(Recording(demo_recording_path()).samples())
TRUTH = np.array([f.true_eyes_m for f in FRAMES])


def test_the_viewer_s_left_eye_is_on_the_right_of_the_picture() -> None:
    assert (TRUTH[:, 0, 1] < TRUTH[:, 1, 1]).all()
    seen = np.array([f.eyes.eyes_m for f in FRAMES if f.eyes is not None])
    assert (seen[:100, 0, 0] > seen[:100, 1, 0]).all() and (seen[:, :, 2] > 0).all()


def test_there_are_two_dropouts_and_a_blink() -> None:
    missing = np.array([f.eyes is None for f in FRAMES])
    starts = np.flatnonzero(np.diff(missing.astype(int)) == 1)
    ends = np.flatnonzero(np.diff(missing.astype(int)) == -1)
    assert (ends - starts).tolist() == [6, 24]
    unsure = [f.sequence for f in FRAMES if f.eyes is not None and f.eyes.confidence.max() < 0.3]
    assert len(unsure) == 3 and np.ptp(unsure) == 2
