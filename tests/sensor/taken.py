"""Collects the samples that a recording's driver has delivered by some time."""

from __future__ import annotations

from runtime.records import SensorFrame
from runtime.sensor.base import SteppedSensor


def taken_until(driver: SteppedSensor, time_ns: int) -> list[SensorFrame]:
    """All samples that have arrived by a time of the run's clock, oldest first, each once."""
    frames = []
    while (following := driver.peek()) is not None and driver.available_ns(following) <= time_ns:
        frames.append(driver.next_sample())
    return frames
