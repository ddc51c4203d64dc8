"""Find known USB depth cameras and any problems with their connection, for the `doctor` command."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from runtime.errors import MissingPart, SensorLost
from runtime.support.extras import missing_extra

UDEV_RULE = "70-phasestack-sensors.rules"
SPEEDS = {1: "low speed (1.5 Mbit/s)", 2: "full speed (12 Mbit/s)", 3: "high speed, USB 2 (480 Mbit/s)"}
SPEEDS |= {4: "SuperSpeed, USB 3 (5 Gbit/s)", 5: "SuperSpeed+, USB 3 (10 Gbit/s)"}
SUPER_SPEED = 4  # libusb's constant for USB 3


class KnownDevice(NamedTuple):
    """A USB depth camera model that the driver `openni2` or `realsense` can open."""

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
    """A connected USB depth camera of a known model."""

    known: KnownDevice
    bus: int
    address: int
    serial: str  # serial number; empty: unknown or not readable
    speed: int  # libusb's speed constant; 0: unknown
    is_accessible: bool  # True if this user may open the device

    def __str__(self) -> str:
        usb_id = f"{self.known.vendor_id:04x}:{self.known.product_id:04x}"
        return f"{self.known.name} ({usb_id}, {SPEEDS.get(self.speed, 'unknown')})"

    def problems(self) -> list[str]:
        """Return the problems that prevent this device from being used, each with a remedy."""
        problems = []
        if self.known.needs_usb3 and 0 < self.speed < SUPER_SPEED:
            problems.append(
                f"connected at {SPEEDS[self.speed]}, but requires USB 3; use a blue port and the original cable"
            )
        if not self.is_accessible:
            problems.append(f"permission denied; install the udev rule {UDEV_RULE} and reconnect the device")
        return problems


def _described(device: Any, known: KnownDevice) -> UsbDevice:
    import usb.core
    import usb.util

    serial, accessible = "", True
    try:
        serial = device.serial_number or ""
    except (usb.core.USBError, NotImplementedError, ValueError):
        accessible = False  # without permission to read strings, pyusb raises ValueError ("no langid")
    finally:
        usb.util.dispose_resources(device)  # reading the serial number has opened the device
    return UsbDevice(known, device.bus or 0, device.address or 0, serial, device.speed or 0, accessible)


def find_devices(backend: Any = None) -> list[UsbDevice]:
    """Return all connected USB depth cameras of known models, by bus and address. Raises MissingPart
    without pyusb or libusb, and SensorLost if devices cannot be listed.
    """
    try:
        import usb.core
    except ImportError as error:
        raise missing_extra(error) or error from None
    try:
        devices: Iterable[Any] = usb.core.find(find_all=True, backend=backend)
        pairs = [(device, _BY_ID.get((device.idVendor, device.idProduct))) for device in devices]
    except usb.core.NoBackendError:
        raise MissingPart("libusb is not installed; run: sudo apt install libusb-1.0-0") from None
    except usb.core.USBError as error:
        raise SensorLost(f"cannot list USB devices: {error}") from None
    connected = [_described(device, known) for device, known in pairs if known is not None]
    return sorted(connected, key=lambda d: (d.bus, d.address))
