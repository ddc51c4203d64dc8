"""Driver `usb-eyes`: an eye tracker that streams eye packets over a USB bulk endpoint."""

from __future__ import annotations

import errno
import logging
from typing import Any

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import SensorLost, SensorTimeout
from runtime.records import SensorFrame
from runtime.sensor.base import Capabilities, DeviceClock, Sensor
from runtime.sensor.eye_packets import EyePacket, PacketReader
from runtime.sensor.usb_devices import UDEV_RULE, UsbDevice, find_device, reset_device

READ_BYTES = 16384  # a whole number of USB packets of any speed, so that no transfer overflows
READ_MS = 50  # one transfer at most: unplugging without an error is noticed, stopping is quick
SILENT_READS = 2  # time-outs in a row after which a device is reset

log = logging.getLogger(__name__)


class UsbEyesDriver(Sensor):
    """The newest packet wins. A device that is silent, or sends only garbage, is reset and given up."""

    name = "usb-eyes"
    capabilities = Capabilities(eye_points=True)

    def __init__(self, settings: SensorSettings, clock: Clock, *, backend: Any = None) -> None:
        """backend: pyusb's, for tests; None: libusb."""
        self._source, self._clock, self._backend = settings.source, clock, backend
        self._device: UsbDevice | None = None
        self._endpoint: Any = None
        self._reader, self._times = PacketReader(), DeviceClock()
        self._silent = 0

    def open(self) -> None:
        import usb.core
        import usb.util

        self.close()
        device = find_device(source=self._source, serial=self.serial, driver=self.name, backend=self._backend)
        try:
            handle = device.handle
            handle.set_configuration()
            interface = handle.get_active_configuration()[(0, 0)]
            usb.util.claim_interface(handle, interface)
            endpoint = usb.util.find_descriptor(interface, custom_match=_is_bulk_in)
        except usb.core.USBError as error:
            usb.util.dispose_resources(device.handle)
            if error.errno == errno.EACCES:
                raise SensorLost(f"{device.known.name}: no permission: install the udev rule {UDEV_RULE}") from None
            raise SensorLost(f"{device.known.name}: cannot be opened ({error})") from None
        if endpoint is None:
            usb.util.dispose_resources(device.handle)
            raise SensorLost(f"{device.known.name}: has no bulk endpoint to read from")
        self._device, self._endpoint, self.serial = device, endpoint, device.serial
        self._reader, self._times = PacketReader(), DeviceClock()
        self._silent = 0

    def read_newest(self, timeout_s: float) -> SensorFrame:
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        packets: list[EyePacket] = []
        while not packets:
            remaining_ms = (deadline_ns - self._clock.now_ns()) // 1_000_000
            if remaining_ms <= 0:
                self._silence(timeout_s)
            packets = self._packets(max(1, min(READ_MS, remaining_ms)))
        # Whatever else has arrived is newer; a device that sends without a pause must not keep us here.
        while self._clock.now_ns() < deadline_ns and (more := self._packets(1)):
            packets += more
        arrival_ns = self._clock.now_ns()
        capture_ns = [self._times.host_ns(p.device_time_us * 1000, arrival_ns=arrival_ns) for p in packets]
        self.skipped += len(packets) - 1
        self._silent = 0
        return SensorFrame(packets[-1].sequence, capture_ns[-1], packets[-1].points)

    def _packets(self, wait_ms: int) -> list[EyePacket]:
        """Packets of one transfer; none where it brought none in time."""
        import usb.core

        if self._endpoint is None or self._device is None:
            raise SensorLost("not open")
        try:
            data = self._endpoint.read(READ_BYTES, timeout=wait_ms)
        except usb.core.USBTimeoutError:
            return []
        except usb.core.USBError as error:
            if error.errno == errno.EPIPE:
                self._reset("the endpoint stalled")
            raise SensorLost(f"{self._device.known.name}: {error.strerror or error}") from None
        return self._reader.feed(bytes(data))

    def _silence(self, timeout_s: float) -> None:
        """Raises SensorTimeout; the second time in a row, after a reset, SensorLost."""
        self._silent += 1
        reason = f"no packet for {timeout_s * self._silent:g} s"
        if self._reader.garbage_bytes:
            reason += f", {self._reader.garbage_bytes} bytes were not packets"
        if self._silent >= SILENT_READS:
            self._reset(reason)
        raise SensorTimeout(reason)

    def _reset(self, reason: str) -> None:
        device, self._device, self._endpoint = self._device, None, None
        if device is not None:
            log.warning("%s: %s; it is reset", device.known.name, reason)
            reset_device(device)
        raise SensorLost(f"{reason}; the device was reset")

    def close(self) -> None:
        if self._device is not None:
            import usb.core
            import usb.util

            device, self._device, self._endpoint = self._device, None, None
            try:
                usb.util.dispose_resources(device.handle)
            except usb.core.USBError as error:  # an unplugged device: nothing is left to release
                log.debug("%s: closing: %s", device.known.name, error)


def _is_bulk_in(endpoint: Any) -> bool:
    import usb.util

    is_in: bool = usb.util.endpoint_direction(endpoint.bEndpointAddress) == usb.util.ENDPOINT_IN
    return is_in and usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
