"""The source of samples: a sensor thread in real time, or a recording on the simulated clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

from runtime.clock import NS_PER_S
from runtime.errors import EndOfRecording, InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Sensor, SteppedSensor

FindEyes = Callable[[SensorFrame], EyePoints | None]
AHEAD_NS = NS_PER_S // 10  # more than from a sample to the display time of a refresh that used it


class Samples(ABC):
    """The presenter's view of the sensor; nothing here waits or lets time pass."""

    stale_inputs: int  # samples that a newer one overtook before they were looked at
    serial: str  # the sensor's, where it is known

    @abstractmethod
    def arrived(self, now_ns: int) -> list[SensorFrame]:
        """Samples that have arrived and were not given yet, in order. Raises EndOfRecording, FatalError."""

    def fault(self) -> str:
        """Why there is no sensor now; empty while all is well."""
        return ""

    def recorded_ahead(self) -> list[SensorFrame]:
        """Samples of the next moment that a recording already holds, for what is known afterwards; else []."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Let the sensor go. May be called twice."""


def finder(sensor: Sensor, make_find: Callable[[], FindEyes] | None) -> FindEyes | None:
    """What finds eyes in the pictures of an open sensor; None where it delivers eyes itself."""
    return None if sensor.capabilities.eye_points or make_find is None else make_find()


def searched(frame: SensorFrame, find: FindEyes | None, *, keep_images: bool = False) -> SensorFrame:
    """A sample with the eyes found in its pictures, which are then dropped unless `keep_images`."""
    if find is not None:
        frame = replace(frame, eyes=find(frame))
    return frame if keep_images else replace(frame, colour=None, depth_mm=None)


class RecordedSamples(Samples):
    """A recording on the simulated clock: each sample arrives at its capture plus the configured latency."""

    def __init__(self, driver: Sensor) -> None:
        """Raises InputError where the driver can't be stepped, or the recording can't be read."""
        if not isinstance(driver, SteppedSensor):
            raise InputError("run", "--max-speed", f"needs a recording, not the sensor {driver.name}")
        self._driver = driver
        self.stale_inputs = 0
        driver.open()
        self.serial = driver.serial

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        if self._driver.peek() is None:
            raise EndOfRecording("no more samples")
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
