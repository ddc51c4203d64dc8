"""The doctor sees what is plugged in and says what stands in the way."""

from __future__ import annotations

import pytest

from runtime.errors import SensorLost
from runtime.sensor.known_devices import KNOWN_DEVICES, known_device
from runtime.sensor.usb_devices import UDEV_RULE, find_device, find_devices, reset_device, usb_report
from tests.sensor.fake_usb import KINECT_V2, FakeDevice, FakeUsb


def test_a_kinect_v2_on_usb_2_is_told_so() -> None:
    (row,) = usb_report(FakeUsb(FakeDevice(KINECT_V2, "K2", speed=3)))
    assert row["name"].startswith("Microsoft Kinect v2") and row["serial"] == "K2"
    assert any("USB 3" in problem for problem in row["problems"])


def test_a_kinect_v2_on_usb_3_has_no_problem() -> None:
    assert usb_report(FakeUsb(FakeDevice(KINECT_V2, speed=4)))[0]["problems"] == []


def test_a_missing_permission_names_the_udev_rule() -> None:
    (row,) = usb_report(FakeUsb(FakeDevice(readable=False)))
    assert any(UDEV_RULE in problem for problem in row["problems"])


def test_a_camera_without_a_driver_says_so() -> None:
    (row,) = usb_report(FakeUsb(FakeDevice((0x8086, 0x0B07), speed=4)))
    assert row["driver"] == "" and any("no driver" in problem for problem in row["problems"])


def test_what_is_no_depth_camera_is_left_alone() -> None:
    assert find_devices(FakeUsb(FakeDevice((0x046D, 0xC52B)))) == []


def test_the_real_bus_can_be_listed() -> None:
    assert isinstance(usb_report(), list)


def test_a_device_is_found_by_its_serial_and_never_guessed() -> None:
    bus = FakeUsb(FakeDevice(serial="A1", address=5), FakeDevice(serial="B2", address=6))
    choice = {"driver": "usb-eyes", "backend": bus}
    assert find_device(source="B2", serial="", **choice).serial == "B2"
    assert find_device(source="1209:0001", serial="A1", **choice).serial == "A1"
    with pytest.raises(SensorLost, match="A1, B2"):
        find_device(source="", serial="", **choice)
    with pytest.raises(SensorLost, match="C3"):
        find_device(source="C3", serial="", **choice)


def test_a_device_that_hangs_is_reset() -> None:
    device = FakeDevice()
    reset_device(find_devices(FakeUsb(device))[0])
    assert device.resets == 1


def test_the_table_names_each_device_once() -> None:
    ids = [(d.vendor_id, d.product_id) for d in KNOWN_DEVICES]
    assert len(ids) == len(set(ids)) and known_device(*KINECT_V2) in KNOWN_DEVICES
