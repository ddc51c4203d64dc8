"""A sensor that delivers images, together with what finds eyes in them, as one driver that delivers eyes.

The search then happens in the sensor's thread, not in the loop's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from runtime.errors import InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Sensor, SteppedSensor

FindEyes = Callable[[SensorFrame], EyePoints | None]


class DetectingDriver(SteppedSensor):
    """Adds eye points to the frames of a driver that has none, and hands those of others through."""

    def __init__(self, driver: Sensor, make_find: Callable[[], FindEyes], *, keep_images: bool = False) -> None:
        """make_find: builds the finder when the driver is opened, if it is needed at all."""
        self._driver, self._make_find, self._keep_images = driver, make_find, keep_images
        self._find: FindEyes | None = None
        self.name, self.capabilities = driver.name, driver.capabilities
        self.serial = driver.serial

    def open(self) -> None:
        self._driver.serial = self.serial
        self._driver.open()
        self.serial, has = self._driver.serial, self._driver.capabilities
        if has.eye_points:
            self.capabilities, self._find = has, None
            return
        try:
            self._find = self._make_find()
        except BaseException:
            self._driver.close()
            raise
        self.capabilities = replace(has, eye_points=True)

    def read_newest(self, timeout_s: float) -> SensorFrame:
        frame = self._driver.read_newest(timeout_s)
        self.skipped = self._driver.skipped
        return self._with_eyes(frame)

    def read_arrived(self, timeout_s: float) -> list[SensorFrame]:
        if self._find is not None:
            # A search takes as long as some cameras' period: only the newest picture is searched.
            return [self.read_newest(timeout_s)]
        frames = self._driver.read_arrived(timeout_s)
        self.skipped = self._driver.skipped
        return [self._with_eyes(frame) for frame in frames]

    @property
    def refused(self) -> Mapping[str, int]:
        return self._driver.refused

    def peek(self) -> SensorFrame | None:
        return self._stepped().peek()

    def next_sample(self) -> SensorFrame:
        return self._with_eyes(self._stepped().next_sample())

    def available_ns(self, frame: SensorFrame) -> int:
        return self._stepped().available_ns(frame)

    def _stepped(self) -> SteppedSensor:
        if not isinstance(self._driver, SteppedSensor):
            raise InputError("run", "--max-speed", f"needs a recording, not the sensor {self.name}")
        return self._driver

    def _with_eyes(self, frame: SensorFrame) -> SensorFrame:
        if self._find is not None:
            frame = replace(frame, eyes=self._find(frame))
        return frame if self._keep_images else replace(frame, colour=None, depth_mm=None)

    def close(self) -> None:
        self._driver.close()
