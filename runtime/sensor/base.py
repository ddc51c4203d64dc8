"""Interface for sensor drivers, and conversion of device timestamps to the host's clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Self

from pydantic import BaseModel

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.config import Section
from runtime.errors import EndOfRecording, SensorLost, SensorTimeout
from runtime.records import SensorFrame

ARRIVED_MAX = 1024  # maximum number of samples returned by one call
WINDOW_NS = 5_000_000_000  # a device clock's offset is estimated over windows of this duration


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Kinds of data that a sensor delivers, and how to treat them."""

    colour: bool = False
    depth: bool = False
    eye_points: bool = False  # the sensor finds the eyes itself, so the eye finder is not used
    in_stack_frame: bool = False  # eye points are in frame `stack` and need no calibration
    may_pause: bool = False  # gaps and constant samples are not faults, for example in a recording


class Sensor(ABC):
    """Base class for drivers of depth cameras, eye trackers and recordings.

    The constructor only stores settings. `open` acquires the device, and cleans up if this fails. A driver is used by
    only one thread. Its process is killed if a call hangs.

    A custom driver is configured by `sensor.driver = "module:Class"` and constructed as `Class(options, clock=clock)`.
    `options` is an instance of the class's `Options`, validated from `[sensor.options]`. `clock` is the run's clock.
    Capture times must be based on it.
    """

    Options: ClassVar[type[BaseModel]] = Section  # schema of [sensor.options] for a custom class

    name: str
    capabilities: Capabilities
    serial: str = ""  # serial number, set by `open` if known; if set earlier, `open` accepts only this device
    skipped: int = 0  # number of samples that `read_newest` dropped because newer samples had arrived

    @abstractmethod
    def open(self) -> None:
        """Acquire the device. Raises SensorLost if a retry may succeed, otherwise FatalError."""

    @abstractmethod
    def read_newest(self, timeout_s: float) -> SensorFrame:
        """Return the newest unread frame, after waiting up to `timeout_s` for a new one. Raises SensorTimeout
        if none arrived, SensorLost if the device must be reopened, and EndOfRecording.
        """

    def read_arrived(self, timeout_s: float) -> list[SensorFrame]:
        """Return all unread frames, oldest first, as `read_newest` does for one (the default)."""
        return [self.read_newest(timeout_s)]

    @abstractmethod
    def close(self) -> None:
        """Release the device without raising an exception. May be called twice or after a failed `open`."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class SteppedSensor(Sensor):
    """Driver that can also deliver samples without waiting, for runs on a simulated clock. A subclass
    implements `open`, which passes an iterator of samples to `_begin`. `read_newest` and `read_arrived` return the
    samples that have arrived according to the run's clock.
    """

    def __init__(self, source: str, clock: Clock, *, latency_ms: float = 0.0) -> None:
        """Store the source's name for messages, and each sample's delay from capture to arrival."""
        self._source, self._clock, self._latency_ns = source, clock, round(latency_ms * NS_PER_MS)
        self._frames: Iterator[SensorFrame] | None = None  # samples that follow `_next`; None if not open
        self._next: SensorFrame | None = None

    def _begin(self, frames: Iterator[SensorFrame]) -> None:
        self._frames, self._next = frames, next(frames, None)

    def close(self) -> None:
        self._frames = self._next = None

    def peek(self) -> SensorFrame | None:
        """Return the sample that `next_sample` will return, or None. Raises SensorLost if not open."""
        if self._frames is None:
            raise SensorLost(f"{self._source}: the recording is not open")
        return self._next

    def next_sample(self) -> SensorFrame:
        """Return the next sample without waiting. Raises EndOfRecording, or SensorLost if not open."""
        frame = self.peek()
        if frame is None or self._frames is None:
            raise EndOfRecording(f"{self._source}: the recording has ended")
        self._next = next(self._frames, None)
        return frame

    def available_ns(self, frame: SensorFrame) -> int:
        """Return a sample's arrival time on the run's clock."""
        return frame.capture_ns + self._latency_ns

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
        """Wait for the oldest unread sample. Raises SensorTimeout, EndOfRecording, or SensorLost if not open."""
        following = self.peek()
        if following is None:
            return self.next_sample()  # raises EndOfRecording
        due_ns = self.available_ns(following)
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        self._clock.sleep_until_ns(min(due_ns, deadline_ns))
        if due_ns > deadline_ns:
            raise SensorTimeout(f"{self.name}: no sample arrived within {timeout_s} s")
        return self.next_sample()


class DeviceClock:
    """Converts device timestamps to the host's clock, based on the fastest recent delivery. The delay
    between a timestamp and the sample's arrival varies, but the minimum delay over a few seconds is nearly constant. A
    new window is started every few seconds, to follow the drift between the two clocks.
    """

    def __init__(self) -> None:
        self._start_ns = 0
        self._offsets: list[int] = []  # minimum offsets in the previous and the current window
        self._last_ns: int | None = None

    def host_ns(self, device_ns: int, *, arrival_ns: int) -> int:
        """Convert a device timestamp to the host's clock, not later than its arrival there."""
        offset = arrival_ns - device_ns
        if self._last_ns is None or device_ns < self._last_ns:  # first sample or restarted device
            self._offsets, self._start_ns = [offset], arrival_ns
        elif arrival_ns - self._start_ns > WINDOW_NS:
            self._offsets, self._start_ns = [self._offsets[-1], offset], arrival_ns
        else:
            self._offsets[-1] = min(self._offsets[-1], offset)
        self._last_ns = device_ns
        return device_ns + min(self._offsets)
