"""The doctor sees what is plugged in and says what stands in the way."""

from __future__ import annotations

import pytest

from runtime.errors import SensorLost
from runtime.sensor.usb_devices import UDEV_RULE, find_device, find_devices
from tests.sensor.fake_usb import KINECT_V2, FakeDevice, FakeUsb


@pytest.mark.parametrize(
    ("device", "problem"),
    [
        (FakeDevice(KINECT_V2, "K2", speed=3), "USB 3"),
        (FakeDevice(readable=False), UDEV_RULE),
    ],
    ids=["a Kinect v2 on USB 2", "no permission"],
)
def test_what_stands_in_the_way_is_told_with_its_remedy(device: FakeDevice, problem: str) -> None:
    (found,) = find_devices(FakeUsb(device))
    assert any(problem in each for each in found.problems())
    assert f"{device.ids[0]:04x}:{device.ids[1]:04x}" in str(found)


def test_a_device_is_found_by_its_serial_and_never_guessed() -> None:
    bus = FakeUsb(FakeDevice(serial="A1", address=5), FakeDevice(serial="B2", address=6))
    choice = {"driver": "usb-eyes", "backend": bus}
    assert find_device(source="B2", serial="", **choice).serial == "B2"
    assert find_device(source="", serial="A1", **choice).serial == "A1"
    with pytest.raises(SensorLost, match="A1, B2"):
        find_device(source="", serial="", **choice)
    with pytest.raises(SensorLost, match="C3"):
        find_device(source="C3", serial="", **choice)
