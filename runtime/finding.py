"""A camera that delivers pictures, made into a sensor that delivers eyes: found in the sensor's own thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from runtime.errors import InputError
from runtime.eyes.detect import EyeFinder
from runtime.records import SensorFrame
from runtime.sensor.base import SensorDriver, SteppedDriver


class FindingDriver(SteppedDriver):
    """Wraps a driver; frames without eye points are searched for eyes, and their pictures go no further."""

    def __init__(self, driver: SensorDriver, make_finder: Callable[[], EyeFinder]) -> None:
        """make_finder: called for the first picture, so that eye trackers load no face finder."""
        self._driver, self._make_finder = driver, make_finder
        self._finder: EyeFinder | None = None
        self.name, self.capabilities, self.serial = driver.name, driver.capabilities, driver.serial

    def open(self) -> None:
        self._driver.serial = self.serial
        self._driver.open()
        self.capabilities, self.serial = self._driver.capabilities, self._driver.serial

    def read_newest(self, timeout_s: float) -> SensorFrame:
        frame = self._driver.read_newest(timeout_s)
        self.overtaken, self.missed = self._driver.overtaken, self._driver.missed
        return self._found(frame)

    def next_sample(self) -> SensorFrame:
        return self._found(self._stepped().next_sample())

    def available_ns(self, frame: SensorFrame) -> int:
        return self._stepped().available_ns(frame)

    def close(self) -> None:
        self._driver.close()

    def _stepped(self) -> SteppedDriver:
        if not isinstance(self._driver, SteppedDriver):
            raise InputError("run", "--max-speed", f"needs a recording, not the sensor {self.name}")
        return self._driver

    def _found(self, frame: SensorFrame) -> SensorFrame:
        if frame.eyes is not None or frame.colour is None:
            return frame
        self._finder = self._finder or self._make_finder()
        return replace(frame, eyes=self._finder.find(frame), colour=None, depth_mm=None)
