"""Known USB depth cameras, as reported by `doctor`."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

UDEV_RULE = "70-phasestack-sensors.rules"
USB2 = {"1.5": "low speed", "12": "full speed", "480": "high speed, USB 2"}  # by Mbit/s, as Linux tells it
SPEEDS = {**USB2, "5000": "SuperSpeed, USB 3", "10000": "SuperSpeed+, USB 3", "20000": "SuperSpeed+, USB 3"}
ATTRIBUTES = ("idVendor", "idProduct", "busnum", "devnum", "speed")


class KnownDevice(NamedTuple):
    """One USB device, opened by the driver `openni2` or `realsense`."""

    vendor_id: int
    product_id: int
    name: str
    needs_usb3: bool = False


KNOWN_DEVICES: tuple[KnownDevice, ...] = (
    KnownDevice(0x045E, 0x02D8, "Microsoft Kinect v2 (Kinect for Windows)", needs_usb3=True),
    KnownDevice(0x045E, 0x02C4, "Microsoft Kinect v2 (Xbox One)", needs_usb3=True),
    KnownDevice(0x1D27, 0x0600, "ASUS Xtion"),
    KnownDevice(0x1D27, 0x0601, "ASUS Xtion / PrimeSense"),
    KnownDevice(0x1D27, 0x0609, "PrimeSense Carmine"),
    KnownDevice(0x2BC5, 0x0401, "Orbbec Astra"),
    KnownDevice(0x2BC5, 0x0403, "Orbbec Astra Pro"),
    KnownDevice(0x2BC5, 0x0407, "Orbbec Astra Mini S"),
    KnownDevice(0x8086, 0x0AD3, "RealSense D415"),
    KnownDevice(0x8086, 0x0B07, "RealSense D435"),
    KnownDevice(0x8086, 0x0B3A, "RealSense D435i"),
    KnownDevice(0x8086, 0x0B5B, "RealSense D405"),
    KnownDevice(0x8086, 0x0B5C, "RealSense D455"),
)
_BY_ID = {(device.vendor_id, device.product_id): device for device in KNOWN_DEVICES}


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A known device that is connected."""

    known: KnownDevice
    speed_mbit_s: str
    is_accessible: bool

    def __str__(self) -> str:
        speed = f"{SPEEDS.get(self.speed_mbit_s, 'speed')} ({self.speed_mbit_s} Mbit/s)"
        return f"{self.known.name} ({self.known.vendor_id:04x}:{self.known.product_id:04x}, {speed})"

    def problems(self) -> list[str]:
        """Problems that prevent its use, each with its remedy."""
        problems = []
        if self.known.needs_usb3 and self.speed_mbit_s in USB2:
            problems.append(f"is on {self.speed_mbit_s} Mbit/s and needs USB 3: use a blue port and the original cable")
        if not self.is_accessible:
            problems.append(f"permission denied: install the udev rule {UDEV_RULE} and plug it in again")
        return problems


def find_devices(listed: Path = Path("/sys/bus/usb/devices"), nodes: Path = Path("/dev/bus/usb")) -> list[UsbDevice]:
    """Find all known devices in Linux' list, in its order. nodes: where the devices themselves are opened."""
    found = []
    for folder in sorted(path.parent for path in listed.glob("*/idVendor")):
        with suppress(OSError):  # unplugged meanwhile
            told = {name: (folder / name).read_text().strip() for name in ATTRIBUTES}
            known = _BY_ID.get((int(told["idVendor"], 16), int(told["idProduct"], 16)))
            if known is not None:
                node = nodes / f"{int(told['busnum']):03d}" / f"{int(told['devnum']):03d}"
                found.append(UsbDevice(known, told["speed"], os.access(node, os.R_OK | os.W_OK)))
    return found
