"""Tests that a sensor is polled, checked and reopened."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, FatalError, SensorLost, SensorTimeout
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from runtime.sensor.live import SensorSetup, SensorThread
from runtime.sensor.polling import SensorState
from tests.waiting import eventually

SETTINGS = SensorSettings(timeout_s=0.05)
DELIVERED = ("picture has", "depth picture has", "eye points have")


class Scripted(Sensor):
    """A driver whose `read_newest` asks the test what to do."""

    name = "scripted"
    capabilities = Capabilities(eye_points=True)

    def __init__(self, act: Callable[..., Any], log: list[str], *, on_open: Callable[..., Any] | None = None) -> None:
        self._act, self._log, self._on_open = act, log, on_open
        self._count = 0

    def open(self) -> None:
        self._log.append(f"open {self.serial}".strip())
        if self._on_open:
            self._on_open()
        self.serial = self.serial or "S7"

    def read_newest(self, timeout_s: float) -> SensorFrame:
        self._count += 1
        self._act()
        return SensorFrame(self._count, time.monotonic_ns())

    def close(self) -> None:
        self._log.append("close")


@pytest.fixture
def started() -> Any:
    workers = []

    def start(act: Any, *, on_open: Any = None, settings: Any = SETTINGS) -> Any:
        log: list[Any] = []
        worker = SensorThread(SensorSetup(lambda: Scripted(act, log, on_open=on_open), settings, MonotonicClock()))
        worker.start()
        workers.append(worker)
        return worker, log

    yield start
    for worker in workers:
        worker.close()


def raiser(error: Any) -> Any:
    def act() -> None:
        time.sleep(0.002)
        raise error

    return act


def test_samples_that_newer_ones_overtook_before_they_were_looked_at_are_counted(started: Callable[..., Any]) -> None:
    read = []
    worker, _ = started(lambda: (read.append(1), time.sleep(0.002)))
    assert eventually(lambda: len(read) > 6)
    frames = worker.arrived(0)
    assert frames[-1].sequence >= 6 and worker.stale_inputs == len(frames) - 1
    assert worker.state == "running" and worker.serial == "S7" and worker.fault() == ""


def test_all_samples_since_the_last_time_are_handed_out_in_order(started: Callable[..., Any]) -> None:
    worker, _ = started(lambda: time.sleep(0.002))
    got = []
    assert eventually(lambda: got.extend(worker.take()) or len(got) >= 40)
    assert [frame.sequence for frame in got] == list(range(1, 1 + len(got))) and worker.stale_inputs == 0


def test_what_nobody_reads_does_not_pile_up(started: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.sensor.polling.QUEUE_MAX", 10)
    monkeypatch.setattr("runtime.sensor.live.UNREAD_MAX", 10)
    read = []
    worker, _ = started(lambda: (read.append(1), time.sleep(0.001)))
    assert eventually(lambda: len(read) > 60)
    frames = worker.take()
    assert [frame.sequence for frame in frames[:10]] == list(range(1, 11)) and len(frames) <= 21
    assert eventually(lambda: worker.take() != [] and worker.stale_inputs >= 20)


def test_a_driver_that_may_pause_is_neither_stalled_nor_reopened(
    started: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Scripted, "capabilities", Capabilities(eye_points=True, may_pause=True))
    worker, log = started(raiser(SensorTimeout("nothing")))
    time.sleep(0.5)
    assert worker.state == "opening" and log == ["open"]


def test_a_lost_device_is_closed_and_reopened_by_its_serial(started: Callable[..., Any]) -> None:
    lose = [False]

    def act() -> None:
        time.sleep(0.002)
        if lose[0]:
            lose[0] = False
            raise SensorLost("unplugged")

    worker, log = started(act)
    assert eventually(worker.take)
    lose[0] = True
    assert eventually(lambda: len(log) >= 3 and worker.state == "running")
    assert log[:3] == ["open", "close", "open S7"]
    assert eventually(worker.take)


def test_attempts_to_reopen_back_off_and_go_on(started: Callable[..., Any]) -> None:
    opened_s = []

    def refuse() -> None:
        opened_s.append(time.monotonic())
        raise SensorLost("not there")

    worker, _ = started(lambda: None, on_open=refuse)
    assert eventually(lambda: len(opened_s) >= 6)
    assert (np.diff(opened_s[:6]) >= np.array([0.02, 0.04, 0.08, 0.1, 0.1]) - 0.001).all()
    assert worker.state == "lost" and worker.reason == "not there"


def test_a_stream_that_stalls_without_an_error_is_reopened(started: Callable[..., Any]) -> None:
    worker, log = started(raiser(SensorTimeout("nothing")))
    assert eventually(lambda: log.count("open") >= 1 and worker.state == "stalled")
    assert eventually(lambda: log.count("open S7") >= 2)


def test_a_fatal_error_is_not_tried_again(started: Callable[..., Any]) -> None:
    worker, log = started(lambda: None, on_open=raiser(FatalError("no such driver")))
    assert eventually(lambda: worker.state == "failed")
    time.sleep(0.1)
    assert log == ["open", "close"]
    with pytest.raises(FatalError, match="no such driver"):
        worker.arrived(0)


def test_the_end_of_a_recording_is_reported_after_its_last_sample(started: Callable[..., Any]) -> None:
    calls = []

    def act() -> None:
        calls.append(1)
        if len(calls) > 1:
            raise EndOfRecording("over")

    worker, _ = started(act)
    assert eventually(lambda: worker.state == "ended")
    assert [frame.sequence for frame in worker.arrived(0)] == [1]
    with pytest.raises(EndOfRecording, match="over"):
        worker.arrived(0)


@pytest.mark.parametrize("ahead_s", [0.3, 1e6, -1e5])
def test_stamps_that_are_not_of_this_machine_s_clock_are_refused(ahead_s: float) -> None:
    clock = MonotonicClock()

    class Astray(Scripted):
        def read_newest(self, timeout_s: float) -> SensorFrame:
            return SensorFrame(1, clock.now_ns() + round(ahead_s * 1e9))

    worker = SensorThread(SensorSetup(lambda: Astray(None, []), SETTINGS, clock))
    worker.start()
    try:
        assert eventually(lambda: worker.state == "failed")
        with pytest.raises(FatalError, match="must report times on the run's clock"):
            worker.arrived(0)
    finally:
        worker.close()


@pytest.mark.parametrize("error", [ZeroDivisionError("inside the SDK"), SystemExit("device lost")])
def test_an_sdk_that_fails_or_exits_is_lost_and_reopened(started: Callable[..., Any], error: BaseException) -> None:
    """Its thread died of `sys.exit()`, and the status stayed well."""
    calls: list[int] = []

    def act() -> None:
        calls.append(1)
        if len(calls) < 3:
            raise error
        time.sleep(0.002)

    worker, log = started(act)
    assert eventually(lambda: worker.state and worker.reason == f"{type(error).__name__}: {error}")
    assert worker.state is SensorState.LOST and worker.fault() == worker.reason
    assert eventually(lambda: worker.state is SensorState.RUNNING, within_s=20)
    assert log.count("open") + log.count("open S7") == 3


class Camera(Scripted):
    """Stamps its pictures as the test says."""

    ahead_ns, frozen = 0, ""  # what of DELIVERED does not change
    delivered = itertools.count()  # by all drivers: a reopened one continues the count
    capabilities = Capabilities(colour=True, eye_points=True)

    def read_newest(self, timeout_s: float) -> SensorFrame:
        time.sleep(0.005)
        self._count += 1
        number = {
            what: 7 if Camera.frozen in (what, "it may pause") else next(Camera.delivered) % 200 + 8
            for what in DELIVERED
        }
        picture = np.full((16, 16, 3), number["picture has"], np.uint8)
        measured = Camera.frozen != "nothing is measured"
        depth = np.full((16, 16), 600 + number["depth picture has"] if measured else 0, np.uint16)
        eyes = EyePoints(np.full((2, 3), number["eye points have"] / 1000.0), np.ones(2))
        stamp_ns = time.monotonic_ns() + Camera.ahead_ns
        return SensorFrame(
            self._count, stamp_ns, None if Camera.frozen == "nobody is seen" else eyes, picture, depth_mm=depth
        )


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(Camera, "ahead_ns", 0)
    monkeypatch.setattr(Camera, "frozen", "")
    worker = SensorThread(SensorSetup(lambda: Camera(None, []), SETTINGS, MonotonicClock()))
    worker.start()
    assert eventually(lambda: worker.state is SensorState.RUNNING)
    yield worker
    worker.close()


def test_future_stamps_are_rejected_and_a_persistent_sensor_counts_as_lost(
    camera: SensorThread, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once later samples were ignored: 105 mm off, with a sigma of 2 mm."""
    monkeypatch.setattr(Camera, "ahead_ns", 900_000_000)
    camera.take()
    assert eventually(lambda: camera.state is SensorState.LOST)
    assert "capture times are off by +0.9" in camera.fault()
    time.sleep(0.3)  # it is reopened meanwhile
    assert camera.state is not SensorState.FAILED
    assert all(frame.capture_ns <= time.monotonic_ns() for frame in camera.take())
    monkeypatch.setattr(Camera, "ahead_ns", 0)
    assert eventually(lambda: camera.state is SensorState.RUNNING)


@pytest.mark.parametrize("what", ["picture has", "depth picture has", "eye points have"])
def test_a_sensor_whose_samples_never_change_is_lost_until_they_do(
    camera: SensorThread, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """Frozen eyes were once at rest with a sigma of 0.7 mm. Changing colour does not hide frozen depth."""
    monkeypatch.setattr("runtime.sensor.polling.FROZEN_NS", 100_000_000)
    monkeypatch.setattr(Camera, "frozen", what)
    assert eventually(lambda: camera.state is SensorState.LOST)
    assert camera.fault() == f"the {what} not changed for 0.1 s"
    for _ in range(30):  # reopened, it is unhealthy for a moment each time
        time.sleep(0.01)
        assert camera.state is SensorState.LOST
    monkeypatch.setattr(Camera, "frozen", "")
    assert eventually(lambda: camera.state is SensorState.RUNNING)


@pytest.mark.parametrize("still", ["nobody is seen", "nothing is measured", "it may pause"])
def test_what_may_stay_the_same_is_no_fault(camera: SensorThread, monkeypatch: pytest.MonkeyPatch, still: str) -> None:
    monkeypatch.setattr("runtime.sensor.polling.FROZEN_NS", 50_000_000)
    if still == "it may pause":
        monkeypatch.setattr(Camera, "capabilities", Capabilities(eye_points=True, may_pause=True))
    monkeypatch.setattr(Camera, "frozen", still)
    for _ in range(40):
        time.sleep(0.01)
        assert camera.state is SensorState.RUNNING
