"""Sources of a live sensor's samples: a separate process, or a thread for what cannot hang or crash."""

from __future__ import annotations

import queue
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from runtime.clock import Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, FatalError
from runtime.records import SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from runtime.sensor.polling import FOREVER_S, PICTURES_MAX, Polling, SensorState, SensorUpdate
from runtime.sensor.samples import Finder, Samples
from runtime.support.background import begin, patience_s
from runtime.support.channel import ChannelClosed
from runtime.support.process import Began, Ended, Parent, Role, Worker
from runtime.support.untrusted_input import MIB

UNREAD_MAX = 256  # maximum number of updates that a thread leaves unread
MEMORY_BYTES = 2048 * MIB  # limit for the memory of the sensor's process
IDLE_S = 60.0  # interval for looking whether the sensor is to be opened
OPENS_WITHIN_S = 0.25  # how long a run waits for a sensor before it begins without one
LOOK_S = 0.002
OOM_SCORE = 300  # less than the solver's, because a viewer who is not seen is worse than an old solution


class LiveSamples(Samples):
    """Samples of a sensor that is polled in parallel. No method waits, except `start` and `close`."""

    def __init__(self) -> None:
        self.on_found: Callable[[Mapping[str, Any]], None] = lambda found: None  # called with each `Finder.found`
        self._latest = SensorUpdate()
        self._frames: list[SensorFrame] = []
        self._skipped = 0

    def start(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Have the sensor opened and polled, and wait a moment for it, unless `go_on` returns False. Raises
        PhasestackError if the driver cannot be created.
        """
        self._begin(go_on)
        until_s = time.monotonic() + OPENS_WITHIN_S
        while self.state is SensorState.OPENING and time.monotonic() < until_s:
            time.sleep(LOOK_S)

    @abstractmethod
    def _begin(self, go_on: Callable[[], bool]) -> None:
        """Have the sensor opened and polled."""

    @abstractmethod
    def _take_in(self) -> None:
        """Take in all updates that have arrived."""

    def _updated(self, update: SensorUpdate) -> None:
        self._frames += update.frames
        self._latest = replace(update, frames=(), found=None)
        if update.found is not None:
            self.on_found(update.found)

    def take(self) -> list[SensorFrame]:
        """Return all unread samples, oldest first."""
        self._take_in()
        frames, self._frames = self._frames, []
        return frames

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        if frames := self.take():
            self._skipped += len(frames) - 1
        elif self._latest.state is SensorState.ENDED:
            raise EndOfRecording(self._latest.reason)
        elif self._latest.state is SensorState.FAILED:
            raise self._latest.error or FatalError(self._latest.reason)
        return frames

    def fault(self) -> str:
        self._take_in()
        latest = self._latest
        if latest.state in (SensorState.RUNNING, SensorState.OPENING, SensorState.ENDED):
            return ""
        return latest.reason or str(latest.state)

    @property
    def state(self) -> SensorState:
        """The sensor's state. `reason` explains it."""
        self._take_in()
        return self._latest.state

    @property
    def reason(self) -> str:
        return self._latest.reason

    @property
    def error(self) -> FatalError | None:
        """Why the sensor has failed permanently, or None."""
        return self._latest.error

    @property
    def serial(self) -> str:  # type: ignore[override]
        return self._latest.serial

    @property
    def capabilities(self) -> Capabilities:
        """The driver's capabilities."""
        return self._latest.capabilities

    @property
    def stale_inputs(self) -> int:  # type: ignore[override]
        return self._skipped + self._latest.skipped


@dataclass(frozen=True, slots=True)
class SensorSetup:
    """Parts and settings for polling a sensor. A process needs functions that can be pickled."""

    make_driver: Callable[[], Sensor]
    settings: SensorSettings
    clock: Clock
    make_finder: Callable[[], Finder] | None = None
    keep_images: bool = False


@dataclass(frozen=True, slots=True)
class _Begin:
    """Message that has the sensor opened."""

    serial: str
    was_well: bool


class SensorProcess(LiveSamples):
    """Polls a sensor in a separate process, which is replaced if it crashes or hangs."""

    def __init__(self, setup: SensorSetup) -> None:
        """Start the process, which creates the driver. Raises TransientError if no thread can be started."""
        super().__init__()
        role = Role("sensor", serve, memory_bytes=MEMORY_BYTES, oom_score=OOM_SCORE)
        self._worker = Worker(role, lambda: (setup,))
        self._is_started = self._has_begun = self._was_well = False

    @property
    def descriptor(self) -> int | None:  # type: ignore[override]
        return self._worker.descriptor

    def _begin(self, go_on: Callable[[], bool]) -> None:
        self._worker.wait_ready(go_on)
        self._is_started = True
        self._take_in()

    def _take_in(self) -> None:
        for message in self._worker.receive():
            match message:
                case Began():
                    self._has_begun = False
                case Ended(reason):
                    self._skipped += self._latest.skipped
                    reason = f"{reason}; it is being restarted"
                    self._latest = replace(self._latest, state=SensorState.LOST, reason=reason, skipped=0)
                case SensorUpdate(state=SensorState.OPENING):  # the state is that of the process before
                    self._latest = replace(self._latest, capabilities=message.capabilities)
                case SensorUpdate():
                    self._was_well = self._was_well or message.state is SensorState.RUNNING
                    self._updated(message)
        if self._is_started and not self._has_begun:
            self._has_begun = self._worker.send(_Begin(self.serial, self._was_well))

    def status(self) -> list[dict[str, Any]]:
        return [self._worker.status()]

    def close(self) -> None:
        self._worker.close()


def serve(parent: Parent, setup: SensorSetup) -> None:
    """Poll a sensor until the parent closes the channel. Main function of the sensor's process."""
    recipient = _Presenter(parent)
    polling = Polling(
        setup.make_driver, setup.settings, setup.clock, setup.make_finder, recipient, keep_images=setup.keep_images
    )
    recipient.send(SensorUpdate(capabilities=setup.make_driver().capabilities))
    parent.ready()
    parent.allow(FOREVER_S)
    while not (messages := parent.receive(IDLE_S)):
        pass
    polling.run(serial=messages[-1].serial, was_well=messages[-1].was_well)


class _Presenter:
    """The presenter, as the recipient of a sensor's process."""

    def __init__(self, parent: Parent) -> None:
        self._parent = parent

    def send(self, update: SensorUpdate) -> bool:
        has_pictures = any(frame.colour is not None or frame.depth_mm is not None for frame in update.frames)
        if has_pictures and self._parent.unread >= PICTURES_MAX:  # those of unread messages stay in memory
            return False
        with suppress(ChannelClosed):
            return self._parent.offer(update)
        return False

    def allow(self, seconds: float) -> None:
        self._parent.allow(seconds)

    def is_over(self, wait_s: float) -> bool:
        try:
            self._parent.receive(wait_s)
        except ChannelClosed:
            return True
        return False


class SensorThread(LiveSamples):
    """Polls a driver that can neither hang nor crash, such as the browser's, on a thread of this process."""

    def __init__(self, setup: SensorSetup) -> None:
        super().__init__()
        self._queue: queue.SimpleQueue[SensorUpdate] = queue.SimpleQueue()
        self._over = threading.Event()
        polling = Polling(
            setup.make_driver, setup.settings, setup.clock, setup.make_finder, self, keep_images=setup.keep_images
        )
        self._latest = SensorUpdate(capabilities=setup.make_driver().capabilities)
        self._polling = polling
        self._thread: threading.Thread | None = None

    def _begin(self, go_on: Callable[[], bool]) -> None:
        self._thread = begin("sensor", self._polling.run)

    def send(self, update: SensorUpdate) -> bool:
        has_room = self._queue.qsize() < UNREAD_MAX
        if has_room:
            self._queue.put(update)
        return has_room

    def allow(self, seconds: float) -> None:
        """Do nothing, because there is no time limit."""

    def is_over(self, wait_s: float) -> bool:
        return self._over.wait(wait_s)

    def _take_in(self) -> None:
        with suppress(queue.Empty):
            while True:
                self._updated(self._queue.get_nowait())

    def close(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join(patience_s(1.0))
