"""Driver `fixed`: eyes at a configured position, without a sensor or a calibration."""

from __future__ import annotations

import numpy as np

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import InputError, SensorLost
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Capabilities, SteppedSensor

PERIOD_NS = NS_PER_S // 30


class FixedDriver(SteppedSensor):
    """Delivers one pair of eyes in the `stack` frame, thirty times a second."""

    name = "fixed"
    capabilities = Capabilities(eye_points=True, in_stack_frame=True, may_pause=True)

    def __init__(self, settings: SensorSettings, clock: Clock) -> None:
        """Raise InputError if the settings contain no eye positions."""
        if settings.fixed_eyes_m is None:
            raise InputError("sensor", "fixed_eyes_m", "is required by the driver `fixed`")
        self._eyes = EyePoints(np.array(settings.fixed_eyes_m, dtype=np.float64), np.ones(2))
        self._clock = clock
        self._start_ns: int | None = None
        self._count = 0

    def open(self) -> None:
        self._start_ns, self._count = self._clock.now_ns(), 0

    def next_sample(self) -> SensorFrame:
        if self._start_ns is None:
            raise SensorLost("not open")
        self._count += 1
        capture_ns = self._start_ns + (self._count - 1) * PERIOD_NS
        return SensorFrame(self._count, capture_ns, self._eyes, true_eyes_m=self._eyes.eyes_m)

    def peek(self) -> SensorFrame:
        frame = self.next_sample()
        self._count -= 1
        return frame

    def available_ns(self, frame: SensorFrame) -> int:
        return frame.capture_ns

    def close(self) -> None:
        self._start_ns = None
