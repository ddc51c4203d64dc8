"""The sensor's thread: samples wait in a bounded queue, and a hanging SDK is abandoned."""

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
from runtime.sensor.samples import FindEyes, Samples, finder, searched
from runtime.support.background import begin, patience_s
from runtime.support.extras import missing_extra

TIMEOUTS_TO_REOPEN = 2  # in a row, without an error: then the sensor is reopened
REOPEN_AFTER_S, REOPEN_AFTER_MAX_S = 0.25, 0.5  # the wait before a lost sensor is opened again doubles up to the second
OPEN_TIMEOUT_S = 10.0  # an SDK that takes longer to open is given up and opened anew
HANG_MARGIN_S = 0.5  # beyond its time-out that a read may take before its thread counts as hung
ABANDONED_MAX = 8  # hung threads that are left behind; with more, the sensor is given up
QUEUE_MAX = 1024  # samples that wait to be read: four seconds of the fastest sensor
PICTURES_MAX = 8  # the same of samples that carry pictures
AHEAD_NS = NS_PER_S // 1000  # a capture time later than its arrival by more than this is not of this machine's clock
BEHIND_NS = 60 * NS_PER_S  # nor is one earlier by more than this
FROZEN_NS = 2 * NS_PER_S  # no sensor that is well delivers the same picture or eye points for so long: it has noise
LOOKED_AT = slice(None, None, 4)  # rows and columns of a picture

log = logging.getLogger(__name__)


class SensorState(StrEnum):
    """What the sensor is doing."""

    OPENING = "opening"
    RUNNING = "running"
    STALLED = "stalled"  # open, but nothing new comes
    LOST = "lost"  # closed; reopened with back-off
    HUNG = "hung"  # a call into the SDK does not return; a fresh attempt follows
    ENDED = "ended"  # a recording is over
    FAILED = "failed"  # fatal: not tried again
    STOPPED = "stopped"


class _Attempt:
    """One thread with one driver. Once `abandoned`, its results are ignored."""

    def __init__(self, number: int, run: Callable[[_Attempt], None], *, wait_s: float, deadline_ns: int) -> None:
        """Raises TransientError: no thread at present."""
        self.number, self.abandoned = number, threading.Event()
        self.wait_s, self.deadline_ns = wait_s, deadline_ns
        self.received = 0
        self.thread = begin(f"sensor-{number}", run, self)


class SensorWorker(Samples):
    """Runs a driver in a thread of its own. No method blocks, `close` but for its time-out."""

    def __init__(
        self,
        make_driver: Callable[[], Sensor],
        settings: SensorSettings,
        clock: Clock,
        make_find: Callable[[], FindEyes] | None = None,
        *,
        keep_images: bool = False,
    ) -> None:
        """make_driver: a new unopened driver at each call; make_find: an eye finder, for drivers without."""
        self._make, self._settings, self._clock = make_driver, settings, clock
        self._make_find, self._keep_images = make_find, keep_images
        self._lock, self._watching = threading.Lock(), threading.Lock()
        self._queue: deque[SensorFrame] = deque()
        self._attempt: _Attempt | None = None
        self._hung: list[_Attempt] = []
        self._state, self.reason = SensorState.STOPPED, ""
        self._was_well = False  # a sample was once what it should be
        self._delivered: dict[str, tuple[int, int]] = {}  # the newest one's checksum, and since when it is the same
        self._untimely = ""  # what was wrong with the newest stamp that was
        self._skipped = 0  # samples that a newer one overtook, but those that the driver at hand counts
        self._driver: Sensor | None = None
        self.serial = ""  # of the device, once it was open; it is reopened by this
        self.error: FatalError | None = None

    def start(self) -> None:
        """Begin, in the background."""
        self._state = SensorState.OPENING
        self._begin(0.0)

    def _begin(self, wait_s: float) -> None:
        number = self._attempt.number + 1 if self._attempt else 1
        deadline_ns = self._clock.now_ns() + round((wait_s + OPEN_TIMEOUT_S) * NS_PER_S)
        self._attempt = _Attempt(number, self._run, wait_s=wait_s, deadline_ns=deadline_ns)

    def take(self) -> list[SensorFrame]:
        """All samples that arrived and were not read yet, oldest first."""
        self._watch()
        with self._lock:
            frames = list(self._queue)
            self._queue.clear()
        return frames

    def arrived(self, now_ns: int) -> list[SensorFrame]:
        state = self.state  # read first: the last samples arrive before the state changes to ended
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
        """What the sensor is doing; `reason` says why."""
        self._watch()
        return self._state

    @property
    def stale_inputs(self) -> int:  # type: ignore[override]
        return self._skipped + (self._driver.skipped if self._driver else 0)

    @property
    def capabilities(self) -> Capabilities | None:
        """Of the driver, once it was open."""
        return self._driver.capabilities if self._driver else None

    def close(self, timeout_s: float = 1.0) -> None:
        """Close the driver; where that takes longer than the time-out, leave it behind."""
        attempt, self._attempt = self._attempt, None
        if attempt is not None:
            attempt.abandoned.set()
            attempt.thread.join(patience_s(timeout_s))
        self._state, self.reason = SensorState.STOPPED, ""

    def _watch(self) -> None:
        """Leave a thread behind that is in one call for too long, and begin another."""
        if not self._watching.acquire(blocking=False):
            return  # another thread is at it
        try:
            self._leave_behind(self._attempt)
        finally:
            self._watching.release()

    def _leave_behind(self, attempt: _Attempt | None) -> None:
        if attempt is None or self._clock.now_ns() <= attempt.deadline_ns or not attempt.thread.is_alive():
            return
        self._hung = [a for a in self._hung if a.thread.is_alive()]
        reason = f"a call into the sensor's driver does not return ({len(self._hung) + 1} left behind)"
        if not attempt.abandoned.is_set():
            log.warning("sensor: %s", reason)
            self._set(attempt, SensorState.HUNG, reason)
            attempt.abandoned.set()
            self._account(self._driver)
            self._hung.append(attempt)
        if len(self._hung) <= ABANDONED_MAX:
            with suppress(TransientError):  # no thread at present: tried again at the next look
                self._begin(REOPEN_AFTER_S)

    def _set(self, attempt: _Attempt, state: SensorState, reason: str) -> None:
        with self._lock:
            if not attempt.abandoned.is_set():
                if state != self._state:
                    log.info("sensor: %s%s", state, f" ({reason})" if reason else "")
                self._state, self.reason = state, reason

    def _account(self, driver: Sensor | None) -> None:
        """Keep a driver's count when it goes."""
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
                self._set(attempt, SensorState.LOST, str(error))  # no descriptor, no memory: there may be later
            except TransientError as error:
                self._set(attempt, SensorState.LOST, str(error))
            except BaseException as error:
                if missing := missing_extra(error):
                    self.error = missing
                    self._set(attempt, SensorState.FAILED, str(missing))
                    return
                # An SDK's own exception, or its `sys.exit()`, must not end the daemon: what is broken may come back.
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
            log.exception("sensor: closing it")
        self._account(driver)

    def _receive(self, attempt: _Attempt, driver: Sensor) -> None:
        """Read until the driver fails or the worker stops."""
        s = self._settings
        timeouts, well_ns = 0, self._clock.now_ns()
        if attempt.abandoned.is_set():
            return
        find = finder(driver, self._make_find)
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
                    raise SensorLost(f"nothing new for {timeouts * s.timeout_s:g} s") from error
                continue
            timeouts, now_ns = 0, self._clock.now_ns()
            if not (frames := self._timely(frames, now_ns)):
                if now_ns - well_ns > s.timeout_s * NS_PER_S:
                    raise SensorLost(self._untimely)
                continue
            well_ns, self._was_well = now_ns, True
            if not driver.capabilities.may_pause:
                self._look_at(frames[-1], now_ns)
            overtaken = 0 if find is None else len(frames) - 1  # a search takes a camera's period: only the newest
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
        """Frames with a plausible capture time. Raises FatalError where no frame ever had one."""
        timely = [frame for frame in frames if -AHEAD_NS <= now_ns - frame.capture_ns <= BEHIND_NS]
        if len(timely) < len(frames):
            ahead_s = (frames[-1].capture_ns - now_ns) / NS_PER_S
            self._untimely = f"captures are stamped {ahead_s:+.3f} s from now, not by the run's clock"
            if not self._was_well:
                raise FatalError(self._untimely)
            with self._lock:
                self._skipped += len(frames) - len(timely)
        return timely

    def _look_at(self, frame: SensorFrame, now_ns: int) -> None:
        """Raises SensorLost where a picture, or where the eyes are, never changes.

        Nobody before a tracker, and a depth picture without a measurement, may last.
        """
        looked_at = {
            "picture has": None if frame.colour is None else frame.colour[LOOKED_AT, LOOKED_AT],
            "depth picture has": None if frame.depth_mm is None else frame.depth_mm[LOOKED_AT, LOOKED_AT],
            "eye points have": None if frame.eyes is None else frame.eyes.eyes_m,
        }
        for what, array in looked_at.items():
            checksum = 0 if array is None else zlib.crc32(array.tobytes())
            before, since_ns = self._delivered.get(what, (0, 0))
            if array is None or checksum != before or (what.startswith("depth") and not array.any()):
                self._delivered[what] = checksum, now_ns
            elif now_ns - since_ns > FROZEN_NS:
                raise SensorLost(f"its {what} not changed for {FROZEN_NS / NS_PER_S:g} s")

    def _keep(self, frame: SensorFrame) -> None:
        """Let a sample wait to be read; where too many wait, the oldest goes."""
        most = QUEUE_MAX if frame.colour is None and frame.depth_mm is None else PICTURES_MAX
        while len(self._queue) >= most:
            self._queue.popleft()
            self._skipped += 1
        self._queue.append(frame)
