"""Where a run's samples come from: a sensor thread in real time, or a recording on the simulated clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, FatalError, InputError
from runtime.records import SensorFrame
from runtime.sensor.base import Sensor, SteppedSensor
from runtime.sensor.worker import SensorState, SensorWorker

AHEAD_NS = NS_PER_S // 10  # more than from a sample to the light of a refresh that used it


class Samples(ABC):
    """The presenter's view of the sensor; nothing here waits or lets time pass."""

    stale_inputs: int  # samples that a newer one overtook before they were looked at

    @abstractmethod
    def arrived(self, now_ns: int) -> list[SensorFrame]:
        """Samples that have arrived and were not given yet, in order. Raises EndOfRecording, FatalError."""

    @property
    def refused_inputs(self) -> Mapping[str, int]:
        """Samples that arrived and are none, by reason, as the driver tells them."""
        return {}

    @abstractmethod
    def fault(self) -> str:
        """Why there is no sensor now; empty while all is well."""

    @property
    @abstractmethod
    def serial(self) -> str:
        """The sensor's serial, where it is known."""

    def recorded_ahead(self) -> list[SensorFrame]:
        """Samples of the next moment that a recording holds already; [] of a sensor. For what was known afterwards."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Let the sensor go. May be called twice."""


class RecordedSamples(Samples):
    """A recording on the simulated clock: each sample arrives at its capture plus the configured latency."""

    def __init__(self, driver: Sensor) -> None:
        """Raises InputError where the driver can't be stepped, or the recording can't be read."""
        if not isinstance(driver, SteppedSensor):
            raise InputError("run", "--max-speed", f"needs a recording, not the sensor {driver.name}")
        self._driver = driver
        self.stale_inputs = 0
        driver.open()
        self._next: SensorFrame | None = driver.next_sample()
        self._end: EndOfRecording | None = None

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        if self._next is None and self._end is not None:
            raise self._end
        frames = []
        while self._next is not None and self._driver.available_ns(self._next) <= now_ns:
            frames.append(self._next)
            try:
                self._next = self._driver.next_sample()
            except EndOfRecording as end:
                self._next, self._end = None, end
        self.stale_inputs += max(0, len(frames) - 1)
        return frames

    def recorded_ahead(self) -> list[SensorFrame]:
        frames: list[SensorFrame] = []
        while self._next is not None and (not frames or self._next.capture_ns - frames[0].capture_ns < AHEAD_NS):
            frames.append(self._next)
            try:
                self._next = self._driver.next_sample()
            except EndOfRecording as end:
                self._next, self._end = None, end
        return frames

    def fault(self) -> str:
        return ""

    @property
    def refused_inputs(self) -> Mapping[str, int]:
        return self._driver.refused

    @property
    def serial(self) -> str:
        return self._driver.serial

    def close(self) -> None:
        self._driver.close()


class LiveSamples(Samples):
    """A sensor in its own thread."""

    def __init__(self, make_driver: Callable[[], Sensor], settings: SensorSettings, clock: Clock) -> None:
        self._worker = SensorWorker(make_driver, settings, clock)
        self._skipped = 0
        self._worker.start()

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        frames = self._worker.take()
        self._skipped += max(0, len(frames) - 1)
        if frames:
            return frames
        state = self._worker.state
        if state is SensorState.ENDED:
            raise EndOfRecording(self._worker.reason)
        if state is SensorState.FAILED:
            raise self._worker.error or FatalError(self._worker.reason)
        return []

    def fault(self) -> str:
        if self._worker.state in (SensorState.RUNNING, SensorState.OPENING, SensorState.ENDED):
            return ""
        return self._worker.reason or str(self._worker.state)

    @property
    def stale_inputs(self) -> int:  # type: ignore[override]
        return self._skipped + self._worker.stale_inputs

    @property
    def refused_inputs(self) -> Mapping[str, int]:
        return self._worker.refused_inputs

    @property
    def serial(self) -> str:
        return self._worker.serial

    def close(self) -> None:
        self._worker.stop()
