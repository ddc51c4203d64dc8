"""Depth cameras and eye trackers that phasestack knows by their USB numbers; udev rules are made from this."""

from __future__ import annotations

from typing import NamedTuple


class KnownDevice(NamedTuple):
    """One USB device. `driver` is ours, empty where it needs an SDK for which we have no driver."""

    vendor_id: int
    product_id: int
    name: str
    driver: str = ""
    needs_usb3: bool = False
    note: str = ""


LIBFREENECT2 = "needs libfreenect2's OpenNI2 driver (docs/sensors.md)"
ASTRA = "needs the OpenNI2 driver of Orbbec's OpenNI SDK (docs/sensors.md)"
NO_DRIVER = "no driver yet: docs/sensors.md has a template"

KNOWN_DEVICES: tuple[KnownDevice, ...] = (
    KnownDevice(0x045E, 0x02D8, "Microsoft Kinect v2 (Kinect for Windows)", "openni2", True, LIBFREENECT2),
    KnownDevice(0x045E, 0x02C4, "Microsoft Kinect v2 (Xbox One)", "openni2", True, LIBFREENECT2),
    KnownDevice(0x045E, 0x02AE, "Microsoft Kinect v1 camera", note=NO_DRIVER),
    KnownDevice(0x045E, 0x02BF, "Microsoft Kinect for Windows v1 camera", note=NO_DRIVER),
    KnownDevice(0x045E, 0x097C, "Microsoft Azure Kinect depth camera", "", True, NO_DRIVER),
    KnownDevice(0x045E, 0x097D, "Microsoft Azure Kinect colour camera", "", True, NO_DRIVER),
    KnownDevice(0x1D27, 0x0600, "ASUS Xtion", "openni2"),
    KnownDevice(0x1D27, 0x0601, "ASUS Xtion / PrimeSense", "openni2"),
    KnownDevice(0x1D27, 0x0609, "PrimeSense Carmine", "openni2"),
    KnownDevice(0x2BC5, 0x0401, "Orbbec Astra", "openni2", False, ASTRA),
    KnownDevice(0x2BC5, 0x0403, "Orbbec Astra Pro", "openni2", False, ASTRA),
    KnownDevice(0x2BC5, 0x0407, "Orbbec Astra Mini S", "openni2", False, ASTRA),
    KnownDevice(0x8086, 0x0AD3, "Intel RealSense D415", "", True, NO_DRIVER),
    KnownDevice(0x8086, 0x0B07, "Intel RealSense D435", "", True, NO_DRIVER),
    KnownDevice(0x8086, 0x0B3A, "Intel RealSense D435i", "", True, NO_DRIVER),
    KnownDevice(0x8086, 0x0B5C, "Intel RealSense D455", "", True, NO_DRIVER),
    KnownDevice(0x8086, 0x0B5B, "Intel RealSense D405", "", True, NO_DRIVER),
    KnownDevice(0x1209, 0x0001, "phasestack eye tracker (pid.codes test number)", "usb-eyes"),
)
BY_ID = {(device.vendor_id, device.product_id): device for device in KNOWN_DEVICES}
