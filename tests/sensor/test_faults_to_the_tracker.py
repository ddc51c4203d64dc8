"""Faults happen to a real driver in its thread; what the display would be told of the eyes stays sensible."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.eyes.calibration import load_calibration
from runtime.eyes.tracker import Tracker
from runtime.sensor.eye_packets import EyePacket
from runtime.sensor.usb_eyes import UsbEyesDriver
from runtime.sensor.worker import SensorWorker
from tests.sensor.fake_usb import FakeDevice, FakeUsb, encode, packet

SETTINGS = SensorSettings(driver="usb-eyes", source="", timeout_s=0.1)
PERIOD_S = 0.01


class Stream:
    """A packet every 10 ms; from the 40th to the 60th the fault."""

    def __init__(self, fault: Callable[..., Any]) -> None:
        self._fault, self._start_s, self._sent = fault, time.monotonic(), 0

    def __call__(self) -> bytes:
        due = int((time.monotonic() - self._start_s) / PERIOD_S)
        if due <= self._sent:
            time.sleep(PERIOD_S / 4)
            return b""
        self._sent += 1
        plain = packet(self._sent, time_us=round(self._sent * PERIOD_S * 1e6))
        return encode(self._fault(plain) if 40 <= self._sent < 60 else plain)


def not_a_number(p: EyePacket) -> EyePacket:
    return p._replace(points=replace(p.points, eyes_m=p.points.eyes_m * np.nan))


def backwards(p: EyePacket) -> EyePacket:
    return p._replace(device_time_us=max(0, 10**6 - p.device_time_us))


def duplicate(p: EyePacket) -> EyePacket:
    return p._replace(sequence=40, device_time_us=400_000)


def far_away(p: EyePacket) -> EyePacket:
    return p._replace(points=replace(p.points, eyes_m=p.points.eyes_m + 1e30))


def no_confidence(p: EyePacket) -> EyePacket:
    return p._replace(points=replace(p.points, confidence=np.full(2, np.nan)))


@pytest.mark.parametrize("fault", [not_a_number, backwards, duplicate, far_away, no_confidence])
def test_eyes_stay_where_they_are_through_a_fault_and_after_it(fault: Callable[..., Any]) -> None:
    clock = MonotonicClock()
    bus = FakeUsb(FakeDevice(stream=Stream(fault)))
    worker = SensorWorker(lambda: UsbEyesDriver(SETTINGS, clock, backend=bus), SETTINGS, clock)
    worker.start()
    tracker, labels, last = Tracker(), [], 0
    calibration = load_calibration(None)
    truth = calibration.apply(packet(1).points).eyes_m
    end = time.monotonic() + 5
    while last < 90 and time.monotonic() < end:
        for frame in worker.take():
            last = frame.sequence if frame.sequence > 40 or last < 40 else last
            tracker.update(calibration.apply(frame.eyes), capture_ns=frame.capture_ns)
        answer = tracker.at(clock.now_ns() + 20_000_000)
        if answer.eyes_m is not None:
            assert np.abs(answer.eyes_m - truth).max() < 0.005
            labels.append(answer.label)
        time.sleep(0.002)
    worker.close()
    assert last >= 90 and labels[-1] == "predicted" and worker.reopened == 0
