"""A device's time on the host's clock."""

from __future__ import annotations

WINDOW_NS = 5_000_000_000


class DeviceClock:
    """A device's time on the host's clock: the quickest delivery of the last seconds gives the offset.

    Every delivery is late by some delay; the least delay of a window is close to the least there is, and
    taking a fresh window every few seconds follows the drift between two quartzes.
    """

    def __init__(self) -> None:
        self._start_ns = 0
        self._offsets: list[int] = []  # least of the window before, least of this one
        self._last_ns: int | None = None

    def host_ns(self, device_ns: int, *, arrival_ns: int) -> int:
        """When, on the host's clock, the device said `device_ns`; never after the arrival."""
        offset = arrival_ns - device_ns
        if self._last_ns is None or device_ns < self._last_ns:  # first, or the device was restarted
            self._offsets, self._start_ns = [offset], arrival_ns
        elif arrival_ns - self._start_ns > WINDOW_NS:
            self._offsets, self._start_ns = [self._offsets[-1], offset], arrival_ns
        else:
            self._offsets[-1] = min(self._offsets[-1], offset)
        self._last_ns = device_ns
        return device_ns + min(self._offsets)
