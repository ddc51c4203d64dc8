"""USB depth cameras: finding, watching and resetting them, and a doctor's view of what is plugged in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from runtime.errors import MissingPart, SensorLost
from runtime.sensor.known_devices import BY_ID, KnownDevice

UDEV_RULE = "70-phasestack-sensors.rules"
SPEEDS = {1: "low speed (1.5 Mbit/s)", 2: "full speed (12 Mbit/s)", 3: "high speed, USB 2 (480 Mbit/s)"}
SPEEDS |= {4: "SuperSpeed, USB 3 (5 Gbit/s)", 5: "SuperSpeed+, USB 3 (10 Gbit/s)"}
SUPER_SPEED = 4


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A known device that is plugged in."""

    known: KnownDevice
    bus: int
    address: int
    serial: str  # empty: has none, or may not be read
    speed: int  # libusb's number, 0: unknown
    is_accessible: bool
    handle: Any = field(compare=False, repr=False)  # usb.core.Device

    @property
    def usb_id(self) -> str:
        return f"{self.known.vendor_id:04x}:{self.known.product_id:04x}"

    def __str__(self) -> str:
        return f"{self.known.name} ({self.usb_id}, {SPEEDS.get(self.speed, 'unknown')})"

    def problems(self) -> list[str]:
        """What stands in the way of using it, each with its remedy."""
        found = []
        if self.known.needs_usb3 and 0 < self.speed < SUPER_SPEED:
            found.append(f"is on {SPEEDS[self.speed]} and needs USB 3: use a blue port, and its own cable")
        if not self.is_accessible:
            found.append(f"may not be opened: install the udev rule {UDEV_RULE} and plug it in again")
        return found


def _described(device: Any, known: KnownDevice) -> UsbDevice:
    import usb.core
    import usb.util

    serial, accessible = "", True
    try:
        serial = device.serial_number or ""
    except (usb.core.USBError, NotImplementedError, ValueError):
        accessible = False  # pyusb says ValueError ("no langid") where strings may not be read
    finally:
        usb.util.dispose_resources(device)  # reading the serial opened it; whoever uses it opens it again
    return UsbDevice(known, device.bus or 0, device.address or 0, serial, device.speed or 0, accessible, device)


def find_devices(backend: Any = None) -> list[UsbDevice]:
    """All known devices, in the order of bus and address. Raises MissingPart without libusb."""
    import usb.core

    try:
        devices: Iterable[Any] = usb.core.find(find_all=True, backend=backend)
        pairs = [(device, BY_ID.get((device.idVendor, device.idProduct))) for device in devices]
    except usb.core.NoBackendError:
        raise MissingPart("libusb is not installed (Debian: apt install libusb-1.0-0)") from None
    except usb.core.USBError as error:
        raise SensorLost(f"the USB bus cannot be listed: {error}") from None
    found = [_described(device, known) for device, known in pairs if known is not None]
    return sorted(found, key=lambda d: (d.bus, d.address))


def find_device(*, source: str, serial: str, driver: str, backend: Any = None) -> UsbDevice:
    """The one device of a driver that a source (a serial number, or empty for any) names.

    A serial number, once known, has the last word. Raises SensorLost where it is not plugged in, or more than
    one fits: it is never guessed.
    """
    wanted = serial or ("" if source in ("", "demo", "any") else source)
    fitting = [
        device
        for device in find_devices(backend)
        if device.known.driver == driver and (not wanted or device.serial == wanted)
    ]
    name = wanted or source or "any"
    if not fitting:
        raise SensorLost(f"no device for driver {driver} is plugged in ({name})")
    if len(fitting) > 1:
        serials = ", ".join(device.serial or "without serial" for device in fitting)
        raise SensorLost(f"several devices fit ({serials}): set sensor.source to one's serial number")
    return fitting[0]


def reset_device(device: UsbDevice) -> None:
    """Reset a device that hangs; it comes back under a new address. Raises SensorLost where it can't be."""
    import usb.core
    import usb.util

    try:
        device.handle.reset()
    except (usb.core.USBError, NotImplementedError) as error:
        raise SensorLost(f"{device.known.name}: cannot be reset ({error})") from None
    finally:
        usb.util.dispose_resources(device.handle)
