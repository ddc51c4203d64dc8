"""Driver `replay`: recordings, played in real time or as fast as the caller reads samples."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from runtime.clock import NS_PER_S, Clock
from runtime.errors import InputError
from runtime.records import SensorFrame
from runtime.sensor.base import Capabilities, SteppedSensor
from runtime.sensor.recording import Recording
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger(__name__)


def demo_recording_path() -> Path:
    """Return the path of the demo recording included in the package."""
    return Path(str(files("runtime.sensor") / "data" / "demo.mcap"))


class ReplayDriver(SteppedSensor):
    """Driver that plays back a recording at its original rate, including gaps, starting at `open`. Each
    sample arrives at its capture time plus the latency. If a sample is not later than its predecessor, it is skipped.
    Only the first skipped sample is logged.
    """

    name = "replay"

    def __init__(self, source: str, clock: Clock, *, loop: bool = False, latency_ms: float = 0.0) -> None:
        """Store the path of a recording, or `demo`, to repeat if `loop`. Raises InputError if it is empty."""
        if not source:
            raise InputError("sensor", "source", "is empty; name a recording, or `demo`")
        self.path, self._loop = demo_recording_path() if source == "demo" else Path(source), loop
        super().__init__(str(self.path), clock, latency_ms=latency_ms)
        self.capabilities = Capabilities(eye_points=True, may_pause=True)

    def open(self) -> None:
        """Open the recording. Raises InputError if the file cannot be read or is not a recording."""
        recording = Recording(self.path)
        header = recording.header
        self.serial = header.serial
        self.capabilities = Capabilities(header.colour, header.depth, eye_points=True, may_pause=True)
        self._begin(self._shifted(recording))

    def _ordered(self, recording: Recording) -> Iterator[SensorFrame]:
        """Yield samples with ascending capture times. Raises InputError if the recording is too long."""
        last_ns, is_logged = -1, False
        for number, frame in enumerate(recording.samples()):
            if frame.capture_ns <= last_ns:
                if not is_logged:
                    log.warning(
                        "%s: skipping sample %d and all others that are not later than the previous sample",
                        self.path,
                        frame.sequence,
                    )
                is_logged = True
                continue
            seconds = (frame.capture_ns - recording.first.capture_ns) / NS_PER_S
            if seconds > LIMITS.recording_s:
                problem = (
                    f"sample {number} is {seconds:.6g} s after the first, but the maximum is {LIMITS.recording_s:g} s"
                )
                raise InputError(self.path, "capture_ns", problem)
            last_ns = frame.capture_ns
            yield frame

    def _shifted(self, recording: Recording) -> Iterator[SensorFrame]:
        """Yield samples with capture times on the run's clock. When looping, the first sample follows the last one
        after the same interval as between the last two samples.
        """
        last_ns = interval_ns = sequence_shift = last_sequence = shift_ns = 0
        is_first_round = True
        while True:
            delivered = 0
            for frame in self._ordered(recording):
                if delivered == 0 and is_first_round:
                    shift_ns = self._clock.now_ns() - frame.capture_ns
                elif delivered == 0:
                    shift_ns = last_ns + interval_ns - frame.capture_ns
                    sequence_shift = last_sequence + 1 - frame.sequence
                capture_ns = frame.capture_ns + shift_ns
                interval_ns = capture_ns - last_ns if delivered else interval_ns or NS_PER_S // 30
                last_ns, last_sequence, delivered = capture_ns, frame.sequence + sequence_shift, delivered + 1
                yield replace(frame, capture_ns=capture_ns, sequence=last_sequence)
            is_first_round = False
            if not self._loop or not delivered:
                return
