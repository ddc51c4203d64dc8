"""Where a run's samples come from: a sensor thread in real time, or a recording step by step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, FatalError, InputError
from runtime.records import SensorFrame
from runtime.sensor.base import SensorDriver, SteppedDriver
from runtime.sensor.worker import SensorState, SensorWorker


class Input(ABC):
    """The loop's view of the sensor."""

    stale_inputs: int

    @abstractmethod
    def receive(self) -> SensorFrame | None:
        """The newest unread sample or None. Raises EndOfRecording, FatalError."""

    @abstractmethod
    def fault(self) -> str:
        """Why there is no sensor now; empty while all is well."""

    @abstractmethod
    def wait(self, *, rate_hz: float) -> None:
        """Let time pass until the next turn is due."""

    @property
    @abstractmethod
    def serial(self) -> str:
        """The sensor's serial, where it is known."""

    @abstractmethod
    def close(self) -> None:
        """Let the sensor go. May be called twice."""


class SteppedInput(Input):
    """Each recorded sample gets one turn; the simulated clock is at its arrival."""

    stale_inputs = 0

    def __init__(self, driver: SensorDriver, clock: Clock) -> None:
        """Raises InputError where the driver can't be stepped, or the recording can't be read."""
        if not isinstance(driver, SteppedDriver):
            raise InputError("run", "--max-speed", f"needs a recording, not the sensor {driver.name}")
        self._driver, self._clock = driver, clock
        driver.open()

    def receive(self) -> SensorFrame:
        frame = self._driver.next_sample()
        self._clock.sleep_until_ns(self._driver.available_ns(frame))
        return frame

    def fault(self) -> str:
        return ""

    def wait(self, *, rate_hz: float) -> None:
        return

    @property
    def serial(self) -> str:
        return self._driver.serial

    def close(self) -> None:
        self._driver.close()


class LiveInput(Input):
    """A sensor in its own thread; turns are paced on absolute deadlines."""

    def __init__(self, make_driver: Callable[[], SensorDriver], settings: SensorSettings, clock: Clock) -> None:
        self._worker = SensorWorker(make_driver, settings, clock)
        self._clock = clock
        self._due_ns = clock.now_ns()
        self._worker.start()

    def receive(self) -> SensorFrame | None:
        frame = self._worker.newest()
        if frame is not None:
            return frame
        state = self._worker.state
        if state is SensorState.ENDED:
            raise EndOfRecording(self._worker.reason)
        if state is SensorState.FAILED:
            raise self._worker.error or FatalError(self._worker.reason)
        return None

    def fault(self) -> str:
        if self._worker.state in (SensorState.RUNNING, SensorState.OPENING, SensorState.ENDED):
            return ""
        return self._worker.reason or str(self._worker.state)

    def wait(self, *, rate_hz: float) -> None:
        period_ns = round(NS_PER_S / rate_hz)
        # A late turn is not made up for: the next one is due a period after now.
        self._due_ns = max(self._due_ns + period_ns, self._clock.now_ns())
        self._clock.sleep_until_ns(self._due_ns)

    @property
    def stale_inputs(self) -> int:  # type: ignore[override]
        return self._worker.stale_inputs

    @property
    def serial(self) -> str:
        return self._worker.serial

    def close(self) -> None:
        self._worker.stop()
