"""Tests that the doctor lists connected depth cameras and their problems."""

from __future__ import annotations

import errno
from array import array
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import usb.backend
from usb.core import USBError

from runtime.sensor.usb_devices import UDEV_RULE, find_devices


@dataclass(eq=False)
class Plugged:
    ids: tuple[int, int]
    speed: int = 4
    readable: bool = True  # False: permission is missing


class FakeUsb(usb.backend.IBackend):
    """Fake bus with the calls that pyusb makes to find devices and read serial numbers."""

    def __init__(self, *devices: Plugged) -> None:
        super().__init__()
        self.devices = devices

    def enumerate_devices(self) -> Any:
        return self.devices

    def get_device_descriptor(self, dev: Plugged) -> Any:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0300, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=dev.ids[0], idProduct=dev.ids[1], bcdDevice=0x0100, iManufacturer=0,
            iProduct=0, iSerialNumber=1, bNumConfigurations=0, address=5, bus=1, port_number=5, port_numbers=(5,),
            speed=dev.speed,
        )  # fmt: skip

    def open_device(self, dev: Plugged) -> Plugged:
        if not dev.readable:
            raise USBError("permission", -1, errno.EACCES)
        return dev

    def close_device(self, dev_handle: Plugged) -> None: ...

    def ctrl_transfer(self, dev_handle: Plugged, kind: int, request: int, value: int, *data: Any) -> int:
        text = {0: b"\x09\x04", 1: "K2".encode("utf-16-le")}[value & 0xFF]
        answer = array("B", bytes([len(text) + 2, 3]) + text)
        data[1][: len(answer)] = answer
        return len(answer)


@pytest.mark.parametrize(
    ("device", "problem"),
    [(Plugged((0x045E, 0x02D8), speed=3), "USB 3"), (Plugged((0x1D27, 0x0600), readable=False), UDEV_RULE)],
    ids=["a Kinect v2 on USB 2", "no permission"],
)
def test_what_stands_in_the_way_is_told_with_its_remedy(device: Plugged, problem: str) -> None:
    (found,) = find_devices(FakeUsb(device, Plugged((1, 2))))
    assert any(problem in each for each in found.problems())
    assert f"{device.ids[0]:04x}:{device.ids[1]:04x}" in str(found)


def test_a_camera_that_may_be_opened_is_known_by_its_serial() -> None:
    (found,) = find_devices(FakeUsb(Plugged((0x045E, 0x02D8))))
    assert found.serial == "K2" and not found.problems()
