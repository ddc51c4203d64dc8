"""Sample sources: a sensor in real time (`live.py`), or a recording played against a simulated clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

from runtime.clock import NS_PER_S
from runtime.errors import EndOfRecording, InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Sensor, SteppedSensor

AHEAD_NS = NS_PER_S // 10  # longer than the time from a sample's capture to the display of the refresh that uses it


class Finder(Protocol):
    """Finds eyes in a sensor's pictures."""

    @property
    def found(self) -> Mapping[str, Any] | None:
        """The last picture and the pupils found in it, for pages to show; None if nothing is to be shown."""

    def find_all(self, frame: SensorFrame) -> tuple[EyePoints, ...]:
        """Return all people's eyes in frame `sensor`, nearest first."""


class Samples(ABC):
    """Interface that lets the presenter take samples from a sensor without waiting."""

    stale_inputs: int  # number of samples replaced by a newer one before use
    serial: str  # the sensor's serial number; empty: unknown
    descriptor: int | None = None  # file descriptor that is readable when samples have arrived; None: unknown

    @abstractmethod
    def arrived(self, now_ns: int) -> list[SensorFrame]:
        """Return the samples since the last call, oldest first. Raises EndOfRecording or FatalError."""

    def fault(self) -> str:
        """Return the reason why the sensor is not working, or an empty string."""
        return ""

    def status(self) -> list[dict[str, Any]]:
        """Return the sensor's process and its resources, for the status. Empty if it is this process."""
        return []

    def recorded_ahead(self) -> list[SensorFrame]:
        """Return the recorded samples shortly after the last refresh, for evaluation; none of a live sensor."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Release the sensor. May be called twice."""


def searched(frame: SensorFrame, finder: Finder | None, *, keep_images: bool = False) -> SensorFrame:
    """Return a sample with the eyes found in its pictures, without the pictures themselves unless
    `keep_images`. No finder leaves the sample's eyes unchanged.
    """
    if finder is not None:
        first, *others = finder.find_all(frame) or (None,)
        frame = replace(frame, eyes=first, others=tuple(others))
    return frame if keep_images else replace(frame, colour=None, depth_mm=None)


class RecordedSamples(Samples):
    """A recording played back against a simulated clock: samples arrive after capture and latency."""

    def __init__(self, driver: Sensor) -> None:
        """Open the driver. Raises InputError if it must wait for samples, or cannot read the recording."""
        if not isinstance(driver, SteppedSensor):
            raise InputError("run", "--max-speed", f"requires a recording, not the sensor {driver.name}")
        self._driver = driver
        self.stale_inputs = 0
        driver.open()
        self.serial = driver.serial

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        if self._driver.peek() is None:
            raise EndOfRecording("the recording has ended")
        frames = self._next_while(lambda frame: self._driver.available_ns(frame) <= now_ns)
        self.stale_inputs += max(0, len(frames) - 1)
        return frames

    def recorded_ahead(self) -> list[SensorFrame]:
        first = self._driver.peek()
        if first is None:
            return []
        return self._next_while(lambda frame: frame.capture_ns - first.capture_ns < AHEAD_NS)

    def _next_while(self, holds: Callable[[SensorFrame], bool]) -> list[SensorFrame]:
        frames = []
        while (following := self._driver.peek()) is not None and holds(following):
            frames.append(searched(self._driver.next_sample(), None))
        return frames

    def close(self) -> None:
        self._driver.close()
