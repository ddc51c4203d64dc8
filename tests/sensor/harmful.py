"""Drivers for tests of the sensor's process. One does to the process what a file says."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from runtime.clock import NS_PER_S, Clock
from runtime.config import Section
from runtime.errors import FatalError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from tests.deeds import DEEDS

EYES_M = np.array([[0.7, -0.031, 0.0], [0.7, 0.031, 0.0]])


class HarmfulOptions(Section):
    """Options of the driver."""

    file: str
    opening: bool = False  # do it in `open`, not in `read_newest`
    walking: bool = False  # walk 0.3 m to either side every four seconds instead of swaying


def _refuses() -> None:
    raise FatalError("no such device")


SENSOR_DEEDS = DEEDS | {"refuse": _refuses}


class Harmful(Sensor):
    """Two eyes that sway, a hundred times a second. It does the deed in its file once."""

    name = "harmful"
    capabilities = Capabilities(eye_points=True, in_stack_frame=True)
    Options = HarmfulOptions

    def __init__(self, options: HarmfulOptions, *, clock: Clock) -> None:
        self._file, self._opening, self._clock, self._count = Path(options.file), options.opening, clock, 0
        self._walking = options.walking

    def open(self) -> None:
        self.serial = self.serial or f"H-{os.getpid()}"
        self._do_deed(self._opening)

    def read_newest(self, timeout_s: float) -> SensorFrame:
        time.sleep(0.01)
        self._do_deed(not self._opening)
        self._count += 1
        now_ns = self._clock.now_ns()
        aside_m = 0.3 * np.sin(np.pi / 2 * now_ns / NS_PER_S) if self._walking else 0.002 * np.sin(self._count / 10)
        return SensorFrame(self._count, now_ns, EyePoints(EYES_M + np.array([0.0, aside_m, 0.0]), np.ones(2)))

    def _do_deed(self, now: bool) -> None:
        deed = ""
        with suppress(FileNotFoundError):
            deed = self._file.read_text() if now else ""
        if deed in SENSOR_DEEDS:  # it may be only half-written
            if deed != "exit":  # which the process outlives
                self._file.unlink()
            SENSOR_DEEDS[deed]()

    def close(self) -> None:
        """Nothing to release."""


PICTURE_PX = 240, 320


class Large(Sensor):
    """A camera that is faster than its reader, and counts its pictures in a file."""

    name = "large"
    capabilities = Capabilities(colour=True, may_pause=True)

    def __init__(self, file: Path) -> None:
        self._file, self._count = file, 0

    def open(self) -> None:
        """Nothing to open."""

    def read_newest(self, timeout_s: float) -> SensorFrame:
        time.sleep(0.002)
        self._count += 1
        self._file.write_text(str(self._count))
        picture = np.full((*PICTURE_PX, 3), self._count % 256, np.uint8)
        return SensorFrame(self._count, time.monotonic_ns(), colour=picture)

    def close(self) -> None:
        """Nothing to release."""
