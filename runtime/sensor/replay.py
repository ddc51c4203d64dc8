"""Driver `replay`: a recording as if it were a sensor, at its own pace or as fast as it is asked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.errors import EndOfRecording, InputError, SensorLost, SensorTimeout
from runtime.records import SensorFrame
from runtime.sensor.base import Capabilities, SteppedDriver
from runtime.sensor.recording import Recording


def demo_recording_path() -> Path:
    """The built-in recording, shipped with the package."""
    return Path(str(files("runtime.sensor") / "data" / "demo.mcap"))


class ReplayDriver(SteppedDriver):
    """Recorded times are shifted on to the run's clock: the first sample is captured at `open`.

    `next_sample` delivers every sample once, in order, and never waits: the caller's simulated clock is
    advanced by the caller (a sample is available at `available_ns(frame)`). `read_newest` waits for its
    clock to reach a sample's availability and, like a camera, passes over samples that newer ones overtook.
    """

    name = "replay"

    def __init__(
        self, source: str, clock: Clock, *, loop: bool = False, start_s: float = 0.0, latency_ms: float = 0.0
    ) -> None:
        """source: a recording's path, or `demo`. latency_ms: from a sample's capture to its arrival."""
        self.path = demo_recording_path() if source == "demo" else Path(source)
        self._clock, self._loop, self._start_ns = clock, loop, round(start_s * NS_PER_S)
        self._latency_ns = round(latency_ms * NS_PER_MS)
        self.capabilities = Capabilities(eye_points=True)
        self._frames: Iterator[SensorFrame] | None = None
        self._next: SensorFrame | None = None

    def open(self) -> None:
        """Raises InputError where the file is not a recording, or ends before the start that was asked for."""
        recording = Recording(self.path)
        header = recording.header
        self.serial = header.serial
        self.capabilities = Capabilities(header.colour, header.depth, False, header.eye_points)
        self._frames = self._shifted(recording, self._clock.now_ns())
        self._next = next(self._frames, None)
        if self._next is None:
            self.close()
            raise InputError(self.path, "start", "the recording ends before the time to start at")

    def _shifted(self, recording: Recording, now_ns: int) -> Iterator[SensorFrame]:
        """Samples on the run's clock; when looped, the next round follows at the recording's own interval."""
        start_ns = recording.first.capture_ns + self._start_ns
        shift_ns = now_ns - start_ns
        last_ns = interval_ns = sequence_shift = last_sequence = 0
        while True:
            delivered = 0
            for frame in recording.samples():
                if frame.capture_ns < start_ns:
                    continue
                if delivered == 0:
                    if last_ns:
                        shift_ns = last_ns + interval_ns - frame.capture_ns
                        sequence_shift = last_sequence + 1 - frame.sequence
                    elif self._start_ns:
                        shift_ns = now_ns - frame.capture_ns
                capture_ns = frame.capture_ns + shift_ns
                interval_ns = capture_ns - last_ns if delivered else interval_ns or NS_PER_S // 30
                last_ns, last_sequence, delivered = capture_ns, frame.sequence + sequence_shift, delivered + 1
                yield replace(frame, capture_ns=capture_ns, sequence=last_sequence)
            if not self._loop or not delivered:
                return

    def available_ns(self, frame: SensorFrame) -> int:
        return frame.capture_ns + self._latency_ns

    def next_sample(self) -> SensorFrame:
        if self._frames is None:
            raise SensorLost("the recording is not open")
        if self._next is None:
            raise EndOfRecording(f"{self.path}: no more samples")
        frame, self._next = self._next, next(self._frames, None)
        return frame

    def read_newest(self, timeout_s: float) -> SensorFrame:
        if self._frames is None:
            raise SensorLost("the recording is not open")
        if self._next is None:
            raise EndOfRecording(f"{self.path}: no more samples")
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        if self.available_ns(self._next) > deadline_ns:
            self._clock.sleep_until_ns(deadline_ns)
            raise SensorTimeout(f"{self.path}: no sample within {timeout_s} s")
        self._clock.sleep_until_ns(self.available_ns(self._next))
        frame = self.next_sample()
        while self._next is not None and self.available_ns(self._next) <= self._clock.now_ns():
            frame, self.overtaken = self.next_sample(), self.overtaken + 1
        return frame

    def close(self) -> None:
        self._frames = self._next = None
