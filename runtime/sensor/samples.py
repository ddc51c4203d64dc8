"""Sources of samples: a sensor thread in real time, or a recording on a simulated clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

from runtime.clock import NS_PER_S
from runtime.errors import EndOfRecording, InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Sensor, SteppedSensor

FindEyes = Callable[[SensorFrame], EyePoints | None]
AHEAD_NS = NS_PER_S // 10  # longer than the time from a sample to the display of a refresh that uses it


class Samples(ABC):
    """The presenter's interface to the sensor. No method waits."""

    stale_inputs: int  # samples superseded by a newer one before use
    serial: str  # the sensor's serial number, if known

    @abstractmethod
    def arrived(self, now_ns: int) -> list[SensorFrame]:
        """Return the samples that arrived since the last call, in order. Raises EndOfRecording, FatalError."""

    def fault(self) -> str:
        """Return why there is no working sensor, or an empty string if there is one."""
        return ""

    def recorded_ahead(self) -> list[SensorFrame]:
        """Return a recording's samples just after the last refresh, to evaluate it; [] for a live sensor."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Release the sensor. May be called twice."""


def searched(frame: SensorFrame, find: FindEyes | None, *, keep_images: bool = False) -> SensorFrame:
    """Find the eyes in a sample's pictures, then drop the pictures unless `keep_images` is set."""
    if find is not None:
        frame = replace(frame, eyes=find(frame))
    return frame if keep_images else replace(frame, colour=None, depth_mm=None)


class RecordedSamples(Samples):
    """A recording on the simulated clock: each sample arrives the configured latency after its capture."""

    def __init__(self, driver: Sensor) -> None:
        """Raise InputError if the driver is not a recording's, or if the recording can't be read."""
        if not isinstance(driver, SteppedSensor):
            raise InputError("run", "--max-speed", f"requires a recording, not the sensor {driver.name}")
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
