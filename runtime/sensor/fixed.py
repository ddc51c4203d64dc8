"""Driver `fixed`: eyes at a configured position, for runs without a sensor or a calibration."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.base import Capabilities, SteppedSensor

PERIOD_NS = NS_PER_S // 30


class FixedDriver(SteppedSensor):
    """Driver that delivers the configured eye positions, in frame `stack`, thirty times a second."""

    name = "fixed"
    capabilities = Capabilities(eye_points=True, in_stack_frame=True, may_pause=True)

    def __init__(self, settings: SensorSettings, clock: Clock) -> None:
        """Store the eye positions. Raises InputError if the settings contain no eye positions."""
        if settings.fixed_eyes_m is None:
            raise InputError("sensor", "fixed_eyes_m", "must be set for the driver `fixed`")
        super().__init__(self.name, clock)
        self._eyes = EyePoints(np.array(settings.fixed_eyes_m, dtype=np.float64), np.ones(2))

    def open(self) -> None:
        self._begin(self._samples(self._clock.now_ns()))

    def _samples(self, start_ns: int) -> Iterator[SensorFrame]:
        for number in count():
            yield SensorFrame(number + 1, start_ns + number * PERIOD_NS, self._eyes, true_eyes_m=self._eyes.eyes_m)
