"""The doctor sees what is plugged in and says what stands in the way."""

from __future__ import annotations

import pytest

from runtime.errors import SensorLost
from runtime.sensor.usb_devices import UDEV_RULE, find_device, usb_report
from tests.sensor.fake_usb import KINECT_V2, FakeDevice, FakeUsb


def test_a_kinect_v2_on_usb_2_is_told_so() -> None:
    (row,) = usb_report(FakeUsb(FakeDevice(KINECT_V2, "K2", speed=3)))
    assert row["name"].startswith("Microsoft Kinect v2") and row["serial"] == "K2"
    assert any("USB 3" in problem for problem in row["problems"])


def test_a_missing_permission_names_the_udev_rule() -> None:
    (row,) = usb_report(FakeUsb(FakeDevice(readable=False)))
    assert any(UDEV_RULE in problem for problem in row["problems"])


def test_a_camera_without_a_driver_says_so() -> None:
    (row,) = usb_report(FakeUsb(FakeDevice((0x8086, 0x0B07), speed=4)))
    assert row["driver"] == "" and any("no driver" in problem for problem in row["problems"])


def test_a_device_is_found_by_its_serial_and_never_guessed() -> None:
    bus = FakeUsb(FakeDevice(serial="A1", address=5), FakeDevice(serial="B2", address=6))
    choice = {"driver": "usb-eyes", "backend": bus}
    assert find_device(source="B2", serial="", **choice).serial == "B2"
    assert find_device(source="1209:0001", serial="A1", **choice).serial == "A1"
    with pytest.raises(SensorLost, match="A1, B2"):
        find_device(source="", serial="", **choice)
    with pytest.raises(SensorLost, match="C3"):
        find_device(source="C3", serial="", **choice)
