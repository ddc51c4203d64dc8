"""The driver of streaming eye trackers, against a backend that plays one, faults included."""

from __future__ import annotations

import errno
import time

import numpy as np
import pytest

from runtime.clock import MonotonicClock
from runtime.config import SensorSettings
from runtime.errors import SensorLost
from runtime.sensor.usb_devices import UDEV_RULE
from runtime.sensor.usb_eyes import UsbEyesDriver
from runtime.sensor.worker import SensorWorker
from tests.sensor.fake_usb import FakeDevice, FakeUsb, Ticking, encode, packet
from tests.waiting import eventually

SETTINGS = SensorSettings(driver="usb-eyes", source="", timeout_s=0.1)


def opened(device: FakeDevice) -> UsbEyesDriver:
    driver = UsbEyesDriver(SETTINGS, MonotonicClock(), backend=FakeUsb(device))
    driver.open()
    return driver


def test_eyes_arrive_in_metres_with_their_serial() -> None:
    driver = opened(FakeDevice(transfers=[encode(packet(4, x_m=0.1))]))
    frame = driver.read_newest(0.1)
    np.testing.assert_allclose(frame.eyes.eyes_m, [[0.131, 0, 0.6], [0.069, 0, 0.6]], atol=1e-6)
    assert frame.sequence == 4 and driver.serial == "A1"


def test_the_newest_packet_wins_and_the_others_are_counted() -> None:
    driver = opened(FakeDevice(transfers=[b"".join(encode(packet(k)) for k in (1, 2)), encode(packet(3))]))
    assert driver.read_newest(0.1).sequence == 3 and driver.skipped == 2


def test_a_device_whose_endpoint_stalls_is_reset() -> None:
    device = FakeDevice(transfers=[errno.EPIPE])
    with pytest.raises(SensorLost, match="stalled"):
        opened(device).read_newest(0.2)
    assert device.resets == 1


def test_unplugging_is_lost_and_closing_afterwards_is_quiet() -> None:
    device = FakeDevice(transfers=[encode(packet(1))])
    bus = FakeUsb(device)
    driver = UsbEyesDriver(SETTINGS, MonotonicClock(), backend=bus)
    driver.open()
    bus.devices.clear()
    with pytest.raises(SensorLost):
        driver.read_newest(0.1)
    driver.close()
    driver.close()


def test_a_failed_open_leaves_nothing_open() -> None:
    device = FakeDevice(readable=False)
    driver = UsbEyesDriver(SETTINGS, MonotonicClock(), backend=FakeUsb(device))
    with pytest.raises(SensorLost, match=UDEV_RULE):
        driver.open()
    with pytest.raises(SensorLost, match="not open"):
        driver.read_newest(0.01)


def watched(bus: FakeUsb) -> SensorWorker:
    clock = MonotonicClock()
    worker = SensorWorker(lambda: UsbEyesDriver(SETTINGS, clock, backend=bus), SETTINGS, clock)
    worker.start()
    return worker


def test_a_camera_unplugged_in_mid_stream_is_back_within_a_second_of_its_return() -> None:
    device = FakeDevice(stream=Ticking())
    bus = FakeUsb(device, FakeDevice(serial="ANOTHER", ids=(0x8086, 0x0B07), address=9))
    worker = watched(bus)
    assert eventually(worker.take)
    bus.devices.remove(device)
    assert eventually(lambda: worker.state == "lost")
    # Meanwhile another tracker is plugged in: it is not taken for the one that left.
    bus.devices.append(FakeDevice(serial="B2", address=7, stream=Ticking()))
    time.sleep(0.5)
    worker.take()
    assert worker.state == "lost"
    bus.devices.append(FakeDevice(serial="A1", address=8, stream=Ticking()))
    returned = time.monotonic()
    assert eventually(worker.take)
    assert time.monotonic() - returned < 1.0
    assert worker.serial == "A1"
    worker.close()


def test_after_ten_seconds_worth_of_garbage_a_reset_brings_the_device_back() -> None:
    random = np.random.default_rng(0)
    device = FakeDevice(stream=lambda: random.bytes(4000) if not device.resets else ticking())
    ticking = Ticking()
    worker = watched(FakeUsb(device))
    assert eventually(lambda: device.resets > 0)
    assert eventually(lambda: worker.state == "running")
    worker.close()


def test_a_stream_that_stalls_without_an_error_is_reset_and_comes_back() -> None:
    state = {"stalled": False}
    ticking = Ticking()
    device = FakeDevice(stream=lambda: b"" if state["stalled"] else ticking())
    device.on_reset = lambda: state.update(stalled=False)
    worker = watched(FakeUsb(device))
    assert eventually(worker.take)
    state["stalled"] = True
    assert eventually(lambda: device.resets == 1)
    assert eventually(lambda: worker.take() and worker.state == "running")
    worker.close()
