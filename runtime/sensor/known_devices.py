"""Depth cameras and eye trackers that phasestack knows by their USB numbers; udev rules are made from this."""

from __future__ import annotations

from typing import NamedTuple


class KnownDevice(NamedTuple):
    """One USB device, and the driver of ours that opens it."""

    vendor_id: int
    product_id: int
    name: str
    driver: str
    needs_usb3: bool = False


KNOWN_DEVICES: tuple[KnownDevice, ...] = (
    KnownDevice(0x045E, 0x02D8, "Microsoft Kinect v2 (Kinect for Windows)", "openni2", needs_usb3=True),
    KnownDevice(0x045E, 0x02C4, "Microsoft Kinect v2 (Xbox One)", "openni2", needs_usb3=True),
    KnownDevice(0x1D27, 0x0600, "ASUS Xtion", "openni2"),
    KnownDevice(0x1D27, 0x0601, "ASUS Xtion / PrimeSense", "openni2"),
    KnownDevice(0x1D27, 0x0609, "PrimeSense Carmine", "openni2"),
    KnownDevice(0x2BC5, 0x0401, "Orbbec Astra", "openni2"),
    KnownDevice(0x2BC5, 0x0403, "Orbbec Astra Pro", "openni2"),
    KnownDevice(0x2BC5, 0x0407, "Orbbec Astra Mini S", "openni2"),
    KnownDevice(0x1209, 0x0001, "phasestack eye tracker (pid.codes test number)", "usb-eyes"),
)
BY_ID = {(device.vendor_id, device.product_id): device for device in KNOWN_DEVICES}
