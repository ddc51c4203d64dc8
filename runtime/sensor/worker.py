"""Poll a sensor driver in a thread that queues the samples and reopens the sensor if it is lost.

If the thread hangs in an SDK call, it is abandoned and replaced.
"""

from __future__ import annotations

import logging
import threading
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, FatalError, SensorLost, SensorTimeout, TransientError, is_retryable
from runtime.records import SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from runtime.sensor.samples import FindEyes, Samples, searched
from runtime.support.background import begin, patience_s
from runtime.support.extras import missing_extra

TIMEOUTS_TO_REOPEN = 2  # the sensor is reopened after this number of consecutive timeouts
REOPEN_AFTER_S, REOPEN_AFTER_MAX_S = 0.25, 0.5  # delay before a lost sensor is reopened; doubles up to the maximum
OPEN_TIMEOUT_S = 10.0  # a longer attempt to open the sensor is abandoned and repeated
HANG_MARGIN_S = 0.5  # a read counts as hung this long after its timeout
ABANDONED_MAX = 8  # maximum number of abandoned threads
QUEUE_MAX = 1024  # maximum number of queued samples: four seconds with the fastest sensor
PICTURES_MAX = 8  # maximum number of queued samples with pictures
AHEAD_NS = NS_PER_S // 1000  # a capture time more than this after the arrival is on another clock
BEHIND_NS = 60 * NS_PER_S  # a capture time more than this before the arrival is on another clock
FROZEN_NS = 2 * NS_PER_S  # data that stay identical for longer are a fault, because real data have noise
COMPARED = slice(None, None, 4)  # rows and columns of each picture to compare

log = logging.getLogger(__name__)


class SensorState(StrEnum):
    """State of the sensor connection."""

    OPENING = "opening"
    RUNNING = "running"
    STALLED = "stalled"  # open, but delivers no samples
    LOST = "lost"  # closed, and will be reopened
    HUNG = "hung"  # an SDK call does not return; another attempt follows
    ENDED = "ended"  # the recording has ended
    FAILED = "failed"  # failed permanently; no retry follows
    STOPPED = "stopped"


class _Attempt:
    """Thread that runs one driver. Its results are ignored once `abandoned` is set."""

    def __init__(self, number: int, run: Callable[[_Attempt], None], *, wait_s: float, deadline_ns: int) -> None:
        """Start the thread. Raises TransientError if the system cannot create a thread.

        Args:
            number: Attempt number, for the thread's name.
            run: Function that the thread calls with this attempt.
            wait_s: Time to wait before the sensor is opened.
            deadline_ns: The thread counts as hung after this time. Each of its steps sets a new deadline.
        """
        self.number, self.abandoned = number, threading.Event()
        self.wait_s, self.deadline_ns = wait_s, deadline_ns
        self.received = 0
        self.thread = begin(f"sensor-{number}", run, self)


class SensorWorker(Samples):
    """Sample source that runs a driver in a separate thread. No method except `close` blocks."""

    def __init__(
        self,
        make_driver: Callable[[], Sensor],
        settings: SensorSettings,
        clock: Clock,
        make_find: Callable[[], FindEyes] | None = None,
        *,
        keep_images: bool = False,
    ) -> None:
        """Store the arguments. `start` starts the thread.

        Args:
            make_driver: Function that creates a driver without opening it.
            settings: Sensor settings, including the timeout for a read.
            make_find: Function that creates the eye finder, for drivers that do not find eyes themselves.
            keep_images: Keep the pictures in samples after the eyes have been found.
        """
        self._make, self._settings, self._clock = make_driver, settings, clock
        self._make_find, self._keep_images = make_find, keep_images
        self._lock, self._watching = threading.Lock(), threading.Lock()
        self._queue: deque[SensorFrame] = deque()
        self._attempt: _Attempt | None = None
        self._hung: list[_Attempt] = []
        self._state, self.reason = SensorState.STOPPED, ""
        self._was_well = False  # True once the first valid sample has arrived
        self._delivered: dict[str, tuple[int, int]] = {}  # checksum and time of the last change, by kind of data
        self._untimely = ""  # description of the latest implausible capture time
        self._skipped = 0  # number of samples replaced by newer ones, except those that the current driver counts
        self._driver: Sensor | None = None
        self.serial = ""  # the opened device's serial number, used to reopen the same device
        self.error: FatalError | None = None

    def start(self) -> None:
        """Start the sensor thread and return immediately."""
        self._state = SensorState.OPENING
        self._begin(0.0)

    def _begin(self, wait_s: float) -> None:
        number = self._attempt.number + 1 if self._attempt else 1
        deadline_ns = self._clock.now_ns() + round((wait_s + OPEN_TIMEOUT_S) * NS_PER_S)
        self._attempt = _Attempt(number, self._run, wait_s=wait_s, deadline_ns=deadline_ns)

    def take(self) -> list[SensorFrame]:
        """Return all unread samples, oldest first."""
        self._watch()
        with self._lock:
            frames = list(self._queue)
            self._queue.clear()
        return frames

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        state = self.state  # read before the queue, because the last samples precede the change to ended
        frames = self.take()
        if not frames and state is SensorState.ENDED:
            raise EndOfRecording(self.reason)
        if not frames and state is SensorState.FAILED:
            raise self.error or FatalError(self.reason)
        with self._lock:
            self._skipped += max(0, len(frames) - 1)
        return frames

    def fault(self) -> str:
        if self.state in (SensorState.RUNNING, SensorState.OPENING, SensorState.ENDED):
            return ""
        return self.reason or str(self._state)

    @property
    def state(self) -> SensorState:
        """The sensor's state. `reason` explains it."""
        self._watch()
        return self._state

    @property
    def stale_inputs(self) -> int:  # type: ignore[override]
        return self._skipped + (self._driver.skipped if self._driver else 0)

    @property
    def capabilities(self) -> Capabilities | None:
        """The driver's capabilities, or None while no driver is open."""
        return self._driver.capabilities if self._driver else None

    def close(self, timeout_s: float = 1.0) -> None:
        """Tell the sensor thread to close the driver, and wait up to `timeout_s` for the thread to end."""
        attempt, self._attempt = self._attempt, None
        if attempt is not None:
            attempt.abandoned.set()
            attempt.thread.join(patience_s(timeout_s))
        self._state, self.reason = SensorState.STOPPED, ""

    def _watch(self) -> None:
        """Abandon the sensor thread and start another one if a call in the thread takes too long."""
        if not self._watching.acquire(blocking=False):
            return  # another thread is already doing this
        try:
            self._abandon_if_hung(self._attempt)
        finally:
            self._watching.release()

    def _abandon_if_hung(self, attempt: _Attempt | None) -> None:
        if attempt is None or self._clock.now_ns() <= attempt.deadline_ns or not attempt.thread.is_alive():
            return
        self._hung = [a for a in self._hung if a.thread.is_alive()]
        reason = f"the sensor's driver is not responding ({len(self._hung) + 1} threads abandoned)"
        if not attempt.abandoned.is_set():
            log.warning("sensor: %s", reason)
            self._set(attempt, SensorState.HUNG, reason)
            attempt.abandoned.set()
            self._account(self._driver)
            self._hung.append(attempt)
        if len(self._hung) <= ABANDONED_MAX:
            with suppress(TransientError):  # no thread can be created now; the next `_watch` retries
                self._begin(REOPEN_AFTER_S)

    def _set(self, attempt: _Attempt, state: SensorState, reason: str) -> None:
        with self._lock:
            if not attempt.abandoned.is_set():
                if state != self._state:
                    log.info("sensor: %s%s", state, f" ({reason})" if reason else "")
                self._state, self.reason = state, reason

    def _account(self, driver: Sensor | None) -> None:
        """Add the number of samples skipped by a driver to the total, before the driver is discarded."""
        with self._lock:
            if driver is not None and driver is self._driver:
                self._skipped += driver.skipped
                self._driver = None

    def _allow(self, attempt: _Attempt, limit_s: float) -> None:
        attempt.deadline_ns = self._clock.now_ns() + round(limit_s * NS_PER_S)

    def _run(self, attempt: _Attempt) -> None:
        wait_s, backoff_s = attempt.wait_s, REOPEN_AFTER_S
        while not attempt.abandoned.wait(wait_s):
            driver: Sensor | None = None
            attempt.received = 0
            try:
                driver = self._make()
                driver.serial = driver.serial or self.serial
                self._allow(attempt, OPEN_TIMEOUT_S)
                driver.open()
                self._receive(attempt, driver)
            except EndOfRecording as error:
                self._set(attempt, SensorState.ENDED, str(error))
                return
            except FatalError as error:
                if not is_retryable(error):
                    if not attempt.abandoned.is_set():
                        self.error = error
                    self._set(attempt, SensorState.FAILED, str(error))
                    return
                self._set(attempt, SensorState.LOST, str(error))  # no descriptor or memory; may be temporary
            except TransientError as error:
                self._set(attempt, SensorState.LOST, str(error))
            except BaseException as error:
                if missing := missing_extra(error):
                    self.error = missing
                    self._set(attempt, SensorState.FAILED, str(missing))
                    return
                # An exception or `sys.exit()` in an SDK must not end the daemon, because the sensor may recover.
                log.exception("sensor")
                self._set(attempt, SensorState.LOST, f"{type(error).__name__}: {error}")
            finally:
                if driver is not None:
                    self._allow(attempt, OPEN_TIMEOUT_S)
                    self._close(driver)
            if attempt.abandoned.is_set():
                return
            if attempt.received:
                backoff_s = REOPEN_AFTER_S
            wait_s, backoff_s = backoff_s, min(2 * backoff_s, REOPEN_AFTER_MAX_S)
            self._allow(attempt, wait_s + OPEN_TIMEOUT_S)

    def _close(self, driver: Sensor) -> None:
        try:
            driver.close()
        except BaseException:
            log.exception("sensor: error while closing")
        self._account(driver)

    def _receive(self, attempt: _Attempt, driver: Sensor) -> None:
        """Read and queue samples until the attempt is abandoned.

        Raises:
            SensorLost: The device has failed, no valid samples have arrived for too long, or the data no longer change.
            FatalError: The first capture times are not on the run's clock.
            EndOfRecording: The recording has ended.
        """
        s = self._settings
        timeouts, well_ns = 0, self._clock.now_ns()
        if attempt.abandoned.is_set():
            return
        find = None if driver.capabilities.eye_points or self._make_find is None else self._make_find()
        with self._lock:
            self._driver, self.serial = driver, driver.serial
        while not attempt.abandoned.is_set():
            self._allow(attempt, s.timeout_s + HANG_MARGIN_S)
            try:
                frames = driver.read_arrived(s.timeout_s)
            except SensorTimeout as error:
                if driver.capabilities.may_pause:
                    continue
                timeouts += 1
                self._set(attempt, SensorState.STALLED, str(error))
                if timeouts >= TIMEOUTS_TO_REOPEN:
                    raise SensorLost(
                        f"the sensor has not delivered any samples for {timeouts * s.timeout_s:g} s"
                    ) from error
                continue
            timeouts, now_ns = 0, self._clock.now_ns()
            if not (frames := self._timely(frames, now_ns)):
                if now_ns - well_ns > s.timeout_s * NS_PER_S:
                    raise SensorLost(self._untimely)
                continue
            well_ns, self._was_well = now_ns, True
            if not driver.capabilities.may_pause:
                self._check_changing(frames[-1], now_ns)
            # Find eyes only in the newest frame, because doing so takes as long as a camera's frame period.
            overtaken = 0 if find is None else len(frames) - 1
            frames = [searched(frame, find, keep_images=self._keep_images) for frame in frames[overtaken:]]
            attempt.received += 1
            with self._lock:
                if attempt.abandoned.is_set():
                    return
                self._skipped += overtaken
                for frame in frames:
                    self._keep(frame)
            if self._state is not SensorState.RUNNING:
                self._set(attempt, SensorState.RUNNING, "")

    def _timely(self, frames: list[SensorFrame], now_ns: int) -> list[SensorFrame]:
        """Return the frames whose capture times are plausible.

        Raises FatalError if a capture time is implausible before any valid sample has arrived.
        """
        timely = [frame for frame in frames if -AHEAD_NS <= now_ns - frame.capture_ns <= BEHIND_NS]
        if len(timely) < len(frames):
            ahead_s = (frames[-1].capture_ns - now_ns) / NS_PER_S
            self._untimely = (
                f"the capture times are off by {ahead_s:+.3f} s; the driver must report times on the run's clock"
            )
            if not self._was_well:
                raise FatalError(self._untimely)
            with self._lock:
                self._skipped += len(frames) - len(timely)
        return timely

    def _check_changing(self, frame: SensorFrame, now_ns: int) -> None:
        """Check that the sensor's data keep changing.

        Missing eye points, and depth pictures without any measurements, are not faults. Raises SensorLost if pictures
        or eye points have stayed identical for more than `FROZEN_NS`.
        """
        compared = {
            "picture has": None if frame.colour is None else frame.colour[COMPARED, COMPARED],
            "depth picture has": None if frame.depth_mm is None else frame.depth_mm[COMPARED, COMPARED],
            "eye points have": None if frame.eyes is None else frame.eyes.eyes_m,
        }
        for subject, array in compared.items():
            checksum = 0 if array is None else zlib.crc32(array.tobytes())
            before, since_ns = self._delivered.get(subject, (0, 0))
            if array is None or checksum != before or (subject.startswith("depth") and not array.any()):
                self._delivered[subject] = checksum, now_ns
            elif now_ns - since_ns > FROZEN_NS:
                raise SensorLost(f"the {subject} not changed for {FROZEN_NS / NS_PER_S:g} s")

    def _keep(self, frame: SensorFrame) -> None:
        """Add a sample to the queue. If the queue is full, drop the oldest samples."""
        most = QUEUE_MAX if frame.colour is None and frame.depth_mm is None else PICTURES_MAX
        while len(self._queue) >= most:
            self._queue.popleft()
            self._skipped += 1
        self._queue.append(frame)
