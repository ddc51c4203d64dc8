"""A pyusb backend that plays eye trackers: descriptors, bulk transfers, stalls, garbage, unplugging."""

from __future__ import annotations

import errno
import time
import zlib
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import usb.backend
from usb.core import USBError, USBTimeoutError

from runtime.records import EyePoints
from runtime.sensor.eye_packets import (
    COMPLETED_LEFT,
    COMPLETED_RIGHT,
    CRC,
    HAS_FACE,
    LAYOUT,
    M_PER_MM,
    MAGIC,
    PACKET_BYTES,
    VERSION,
    EyePacket,
)

EYE_TRACKER = (0x1209, 0x0001)
KINECT_V2 = (0x045E, 0x02D8)


def packet(sequence: int, *, time_us: int = 0, x_m: float = 0.0, face: bool = True) -> EyePacket:
    eyes = np.array([[x_m + 0.031, 0.0, 0.6], [x_m - 0.031, 0.0, 0.6]])
    return EyePacket(sequence, time_us, EyePoints(eyes, np.array([0.9, 0.8])) if face else None)


def encode(packet: EyePacket) -> bytes:
    """A packet as a tracker sends it."""
    flags, numbers = 0, [0.0] * 8
    if packet.points is not None:
        flags = HAS_FACE
        flags |= {"": 0, "left": COMPLETED_LEFT, "right": COMPLETED_RIGHT}[packet.points.completed]
        numbers = [*(packet.points.eyes_m.ravel() / M_PER_MM), *packet.points.confidence]
    body = LAYOUT.pack(MAGIC, VERSION, flags, PACKET_BYTES, packet.sequence, packet.device_time_us, *numbers)
    return body + CRC.pack(zlib.crc32(body))


@dataclass(eq=False)
class FakeDevice:
    """One device. `transfers`: what each bulk read answers, bytes or an errno; then what `stream` makes."""

    ids: tuple[int, int] = EYE_TRACKER
    serial: str = "A1"
    speed: int = 3
    address: int = 5
    readable: bool = True  # False: permission is missing
    transfers: list[bytes | int] = field(default_factory=list)
    stream: Callable[[], bytes] | None = None
    resets: int = 0
    on_reset: Callable[[], None] = lambda: None
    closed: int = 0


def _usb_error(number: int) -> USBError:
    kind = USBTimeoutError if number == errno.ETIMEDOUT else USBError
    return kind(errno.errorcode[number], -1, number)


class FakeUsb(usb.backend.IBackend):
    """The bus. Take a device from `devices` to unplug it."""

    def __init__(self, *devices: FakeDevice) -> None:
        super().__init__()
        self.devices = list(devices)

    def _check(self, handle: FakeDevice) -> None:
        if handle not in self.devices:
            raise _usb_error(errno.ENODEV)

    def enumerate_devices(self) -> list[FakeDevice]:
        return list(self.devices)

    def get_device_descriptor(self, dev: FakeDevice) -> Any:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=dev.ids[0], idProduct=dev.ids[1], bcdDevice=0x0100, iManufacturer=0,
            iProduct=0, iSerialNumber=1, bNumConfigurations=1, address=dev.address, bus=1, port_number=dev.address,
            port_numbers=(dev.address,), speed=dev.speed,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: FakeDevice, config: int) -> Any:
        if config:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=b"",
        )  # fmt: skip

    def get_interface_descriptor(self, dev: FakeDevice, intf: int, alt: int, config: int) -> Any:
        if intf or alt or config:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=1,
            bInterfaceClass=255, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=b"",
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: FakeDevice, ep: int, intf: int, alt: int, config: int) -> Any:
        if ep:
            raise IndexError
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=0x81, bmAttributes=2, wMaxPacketSize=512, bInterval=0,
            bRefresh=0, bSynchAddress=0, extra_descriptors=b"",
        )  # fmt: skip

    def open_device(self, dev: FakeDevice) -> FakeDevice:
        self._check(dev)
        if not dev.readable:
            raise _usb_error(errno.EACCES)
        return dev

    def close_device(self, dev_handle: FakeDevice) -> None:
        dev_handle.closed += 1

    def set_configuration(self, dev_handle: FakeDevice, config_value: int) -> None:
        self._check(dev_handle)

    def get_configuration(self, dev_handle: FakeDevice) -> int:
        self._check(dev_handle)
        return 1

    def claim_interface(self, dev_handle: FakeDevice, intf: int) -> None:
        self._check(dev_handle)

    def release_interface(self, dev_handle: FakeDevice, intf: int) -> None:
        self._check(dev_handle)

    def reset_device(self, dev_handle: FakeDevice) -> None:
        self._check(dev_handle)
        dev_handle.resets += 1
        dev_handle.on_reset()

    def ctrl_transfer(
        self, dev_handle: FakeDevice, kind: int, request: int, value: int, index: int, data: Any, timeout: int
    ) -> int:
        self._check(dev_handle)
        text = {0: b"\x09\x04", 1: dev_handle.serial.encode("utf-16-le")}[value & 0xFF]
        answer = array("B", bytes([len(text) + 2, 3]) + text)
        data[: len(answer)] = answer
        return len(answer)

    def bulk_read(self, dev_handle: FakeDevice, ep: int, intf: int, buff: Any, timeout: int) -> int:
        self._check(dev_handle)
        data: bytes | int = b""
        if dev_handle.transfers:
            data = dev_handle.transfers.pop(0)
        elif dev_handle.stream is not None:
            data = dev_handle.stream()
        if isinstance(data, int):
            raise _usb_error(data)
        if not data:
            time.sleep(timeout / 1000)
            raise _usb_error(errno.ETIMEDOUT)
        buff[: len(data)] = array("B", data)
        return len(data)


class Ticking:
    """A device that sends a packet every `period_s`, for as long as it is asked."""

    def __init__(self, *, period_s: float = 0.01, first: int = 1) -> None:
        self._period_s, self._sequence, self._start_s = period_s, first, time.monotonic()
        self._sent = 0

    def __call__(self) -> bytes:
        due = int((time.monotonic() - self._start_s) / self._period_s)
        if due <= self._sent:
            time.sleep(self._period_s / 4)
            return b""
        self._sent += 1
        self._sequence += 1
        return encode(packet(self._sequence, time_us=round(self._sent * self._period_s * 1e6)))
