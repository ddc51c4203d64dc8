"""The driver contract: open, capabilities, read the newest, close; and a device's clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import ClassVar, Self

from pydantic import BaseModel

from runtime.clock import NS_PER_S, Clock
from runtime.config import Section
from runtime.errors import SensorTimeout
from runtime.records import SensorFrame

ARRIVED_MAX = 1024  # samples in one answer: who was away for long gets them in several
WINDOW_NS = 5_000_000_000  # of a device's clock


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a sensor delivers."""

    colour: bool = False
    depth: bool = False
    eye_points: bool = False  # it finds the eyes itself: no detector is needed
    in_stack_frame: bool = False  # its eye points are in frame `stack` already: no calibration is applied
    may_pause: bool = False  # silence is its own (a recording's gap), as are samples that never change: no fault


class Sensor(ABC):
    """One depth sensor, eye tracker or recording.

    A constructor only keeps its settings; `open` acquires and cleans up after itself when it fails.
    One thread uses a driver; that thread may be abandoned when an SDK hangs.

    A class of the user's own is named by `sensor.driver = "module:Class"` and made as `Class(options, clock=clock)`:
    `options` is what `Options` makes of `[sensor.options]`, `clock` the run's clock, which its captures are times of.
    """

    Options: ClassVar[type[BaseModel]] = Section  # of a class of the user's own: what [sensor.options] may hold

    name: str
    capabilities: Capabilities
    serial: str = ""  # known after `open`, empty where the device has none; set before: `open` takes that device only
    skipped: int = 0  # samples that arrived and that `read_newest` passed over for a newer one

    @abstractmethod
    def open(self) -> None:
        """Acquire the device. Raises SensorLost (not there, retry), FatalError (never will be)."""

    @abstractmethod
    def read_newest(self, timeout_s: float) -> SensorFrame:
        """The newest frame not yet read, with its capture time; waits for one, at most `timeout_s`.

        Raises SensorTimeout (nothing new), SensorLost (close and reopen), EndOfRecording.
        """

    def read_arrived(self, timeout_s: float) -> list[SensorFrame]:
        """All frames that have arrived and were not read, oldest first; waits for one, at most `timeout_s`.

        Raises as `read_newest` does. A driver that keeps only the newest answers with that one.
        """
        return [self.read_newest(timeout_s)]

    @abstractmethod
    def close(self) -> None:
        """Release everything. May be called twice, and after a failed `open`; never raises."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SteppedSensor(Sensor):
    """A driver that also delivers sample after sample without waiting, for runs on a simulated clock.

    What it reads by its own clock is what has arrived by then.
    """

    _clock: Clock

    @abstractmethod
    def next_sample(self) -> SensorFrame:
        """The next sample, in order, none left out, at once. Raises EndOfRecording, SensorLost."""

    @abstractmethod
    def peek(self) -> SensorFrame | None:
        """What `next_sample` will deliver, or None where nothing is left. Raises SensorLost."""

    @abstractmethod
    def available_ns(self, frame: SensorFrame) -> int:
        """When a sample arrives, on the run's clock: the caller lets its clock pass until then."""

    def read_newest(self, timeout_s: float) -> SensorFrame:
        *overtaken, newest = self.read_arrived(timeout_s)
        self.skipped += len(overtaken)
        return newest

    def read_arrived(self, timeout_s: float) -> list[SensorFrame]:
        frames = [self._first_due(timeout_s)]
        now_ns = self._clock.now_ns()
        while len(frames) < ARRIVED_MAX and self._is_due(now_ns):
            frames.append(self.next_sample())
        return frames

    def _is_due(self, now_ns: int) -> bool:
        following = self.peek()
        return following is not None and self.available_ns(following) <= now_ns

    def _first_due(self, timeout_s: float) -> SensorFrame:
        """The oldest unread sample, once it is available. Raises SensorTimeout, EndOfRecording, SensorLost."""
        following = self.peek()
        if following is None:
            return self.next_sample()  # it raises the reason
        due_ns = self.available_ns(following)
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        self._clock.sleep_until_ns(min(due_ns, deadline_ns))
        if due_ns > deadline_ns:
            raise SensorTimeout(f"{self.name}: no sample within {timeout_s} s")
        return self.next_sample()


class DeviceClock:
    """A device's time on the host's clock: the quickest delivery of the last seconds gives the offset.

    Every delivery is late by some delay; the least delay of a window is close to the least there is, and
    taking a fresh window every few seconds follows the drift between two quartzes.
    """

    def __init__(self) -> None:
        self._start_ns = 0
        self._offsets: list[int] = []  # least of the window before, least of this one
        self._last_ns: int | None = None

    def host_ns(self, device_ns: int, *, arrival_ns: int) -> int:
        """When, on the host's clock, the device said `device_ns`; never after the arrival."""
        offset = arrival_ns - device_ns
        if self._last_ns is None or device_ns < self._last_ns:  # first, or the device was restarted
            self._offsets, self._start_ns = [offset], arrival_ns
        elif arrival_ns - self._start_ns > WINDOW_NS:
            self._offsets, self._start_ns = [self._offsets[-1], offset], arrival_ns
        else:
            self._offsets[-1] = min(self._offsets[-1], offset)
        self._last_ns = device_ns
        return device_ns + min(self._offsets)
