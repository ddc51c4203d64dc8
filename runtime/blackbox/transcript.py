"""What happens in a run, made into messages: every sample, refresh and log line, and the scene and clocks at times."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from runtime.blackbox import messages, scene
from runtime.blackbox.messages import Message
from runtime.blackbox.pictures import Pictures
from runtime.blackbox.schemas import CLOCK, LOG, PICTURES, REFRESH, SCENE, STATE, TRANSFORMS
from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.optics.stack import PanelStack
from runtime.records import F64, RefreshAccount, SensorFrame
from runtime.sensor import recording_format as fmt

SCENE_EVERY_NS = NS_PER_S // 20
CLOCK_EVERY_NS = NS_PER_S
STEP_NS = 20_000_000  # the wall clock was set where it parts by more


@dataclass(frozen=True, slots=True)
class Sampled:
    """A sample arrived."""

    at_ns: int  # the run's clock
    sample: SensorFrame


@dataclass(frozen=True, slots=True)
class Refreshed:
    """A refresh is complete."""

    account: RefreshAccount
    state: str  # as people read it
    reason: str


@dataclass(frozen=True, slots=True)
class Logged:
    """A line was logged."""

    at_ns: int  # the run's clock
    record: logging.LogRecord


Entry = Sampled | Refreshed | Logged | Pictures


class Transcript:
    """Turns entries into messages; holds what decides whether a message is due. One thread uses it."""

    def __init__(
        self,
        stack: PanelStack,
        settings: Settings,
        *,
        stack_from_sensor: F64,
        in_stack_frame: bool,
        images: bool,
    ) -> None:
        """in_stack_frame: the sensor's points are in `stack`: they are written as a sensor would have seen them."""
        self._stack, self._viewing, self._images = stack, settings.calibration, images
        self._stack_from_sensor = stack_from_sensor
        self._sensor_from_stack = np.linalg.inv(stack_from_sensor) if in_stack_frame else None
        self._offset_ns = 0  # wall less monotonic
        self._state: tuple[str, str] | None = None
        self._scene_ns = self._clock_ns = -NS_PER_S
        self._intrinsics: Any = None
        self._measured: F64 | None = None

    def set_clock(self, *, monotonic_ns: int, wall_ns: int) -> None:
        """What time it is, by both clocks; small differences are this call's own delay, and left alone."""
        offset_ns = wall_ns - monotonic_ns
        if abs(offset_ns - self._offset_ns) > STEP_NS:
            self._offset_ns = offset_ns

    def wall_ns(self, monotonic_ns: int) -> int:
        """Nanoseconds since 1970 of an instant of the run's clock."""
        return monotonic_ns + self._offset_ns

    def standing(self, *, at_ns: int) -> list[Message]:
        """What holds for the whole of a file: frames, panels, viewing range."""
        wall_ns = self.wall_ns(at_ns)
        frames = scene.transforms(self._stack, stack_from_sensor=self._stack_from_sensor, wall_ns=wall_ns)
        still = scene.standing(self._stack, self._viewing, wall_ns=wall_ns)
        return [Message(TRANSFORMS, wall_ns, frames), Message(SCENE, wall_ns, still)]

    def of(self, entry: Entry, *, lost: int) -> Iterator[Message]:
        """The messages of an entry; lost: entries that nobody kept up with, since the start."""
        match entry:
            case Sampled():
                yield from self._sample(entry)
            case Refreshed():
                yield from self._refresh(entry, lost)
            case Pictures():
                wall_ns = self.wall_ns(entry.time_ns)
                for name, jpeg in entry.jpegs.items():
                    frame_id = name.replace("layer", "panel")
                    data = messages.picture(jpeg, frame_id=frame_id, wall_ns=wall_ns)
                    yield Message(PICTURES + name, wall_ns, data, entry.frame & 0xFFFFFFFF)
            case Logged():
                yield _log(entry.record, wall_ns=self.wall_ns(entry.at_ns))

    def _sample(self, entry: Sampled) -> Iterator[Message]:
        sample, wall_ns = entry.sample, self.wall_ns(entry.at_ns)
        eyes = sample.eyes
        if eyes is not None and self._sensor_from_stack is not None:
            matrix = self._sensor_from_stack
            eyes = replace(eyes, eyes_m=eyes.eyes_m @ matrix[:3, :3].T + matrix[:3, 3])
            sample = replace(sample, eyes=eyes)
        self._measured = eyes.eyes_m if eyes is not None else None
        sequence, at = sample.sequence & 0xFFFFFFFF, sample.capture_ns
        if self._images:
            if sample.intrinsics is not None and sample.intrinsics != self._intrinsics:
                self._intrinsics = sample.intrinsics
                data = fmt.calibration_message(sample.intrinsics, capture_ns=at)
                yield Message(fmt.CALIBRATION_TOPIC, wall_ns, data, sequence)
            if sample.colour is not None:
                yield Message(fmt.COLOUR_TOPIC, wall_ns, fmt.colour_message(sample.colour, capture_ns=at), sequence)
            if sample.depth_mm is not None:
                yield Message(fmt.DEPTH_TOPIC, wall_ns, fmt.depth_message(sample.depth_mm, capture_ns=at), sequence)
        yield Message(fmt.EYES_TOPIC, wall_ns, fmt.eyes_message(sample), sequence)

    def _refresh(self, entry: Refreshed, lost: int) -> Iterator[Message]:
        account = entry.account
        at_ns = account.present_ns
        wall_ns = self.wall_ns(at_ns)
        if at_ns - self._clock_ns >= CLOCK_EVERY_NS:
            self._clock_ns = at_ns
            yield Message(CLOCK, wall_ns, messages.clock(monotonic_ns=at_ns, wall_ns=wall_ns, lost=lost))
        if self._state != (entry.state, entry.reason):
            self._state = entry.state, entry.reason
            yield Message(STATE, wall_ns, messages.state(entry.state, entry.reason, monotonic_ns=at_ns))
        yield Message(REFRESH, wall_ns, messages.refresh(account), account.frame & 0xFFFFFFFF)
        if at_ns - self._scene_ns >= SCENE_EVERY_NS:
            self._scene_ns = at_ns
            sigma_m = (account.eye_sigma_mm or 0.0) / 1e3
            eyes = scene.moving(self._stack, eyes_m=account.eyes_m, sigma_m=sigma_m, wall_ns=wall_ns)
            yield Message(SCENE, wall_ns, eyes)
            yield Message(SCENE, wall_ns, scene.measured(self._measured, wall_ns=wall_ns))


def line_of(record: logging.LogRecord) -> str:
    """A log record's message, and the exception that it tells of."""
    text = record.getMessage()
    if record.exc_info and record.exc_info[1] is not None:
        text += f": {type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
    return text


def _log(record: logging.LogRecord, *, wall_ns: int) -> Message:
    text = line_of(record)
    data = messages.log(record.levelno, record.name, text, file=record.filename, line=record.lineno, wall_ns=wall_ns)
    return Message(LOG, wall_ns, data)
