"""Poll a driver, find eyes in its pictures, check its data, and reopen a sensor that is lost."""

from __future__ import annotations

import logging
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Protocol

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, FatalError, SensorLost, SensorTimeout, TransientError, is_retryable
from runtime.records import SensorFrame
from runtime.sensor.base import Capabilities, Sensor
from runtime.sensor.samples import Finder, searched
from runtime.support.extras import missing_extra

TIMEOUTS_TO_REOPEN = 2  # the sensor is reopened after this number of consecutive timeouts
REOPEN_AFTER_S, REOPEN_AFTER_MAX_S = 0.25, 0.5  # delay before a lost sensor is reopened; doubles up to the maximum
OPEN_TIMEOUT_S = 10.0  # time limit for opening and closing a sensor, and for loading the eye finder's networks
HANG_MARGIN_S = 1.0  # a read hangs if it takes this much longer than its timeout
FOREVER_S = 1e9
SEND_AGAIN_S = 0.05  # interval for sending again samples that did not fit
QUEUE_MAX = 1024  # maximum number of unsent samples: four seconds with the fastest sensor
PICTURES_MAX = 8  # maximum number of unsent samples with pictures
AHEAD_NS = NS_PER_S // 1000  # a capture time more than this after the arrival is on another clock
BEHIND_NS = 60 * NS_PER_S  # a capture time more than this before the arrival is on another clock
FROZEN_NS = 2 * NS_PER_S  # data that stay identical for longer are a fault, because real data have noise
NOTHING = Capabilities()
COMPARED = slice(None, None, 4)  # rows and columns of each picture to compare

log = logging.getLogger("phasestack.sensor")


class SensorState(StrEnum):
    """State of the sensor connection."""

    OPENING = "opening"
    RUNNING = "running"
    STALLED = "stalled"  # open, but delivers no samples
    LOST = "lost"  # closed, and will be reopened
    ENDED = "ended"  # the recording has ended
    FAILED = "failed"  # failed permanently; no retry follows


@dataclass(frozen=True, slots=True)
class SensorUpdate:
    """The samples since the last update, oldest first, and the sensor's state."""

    frames: tuple[SensorFrame, ...] = ()
    state: SensorState = SensorState.OPENING
    reason: str = ""  # explains the state
    serial: str = ""  # of the opened device, which is used to reopen the same device
    capabilities: Capabilities = NOTHING  # those of a recording are complete only once it is open
    skipped: int = 0  # number of samples so far that were not delivered because of newer ones
    error: FatalError | None = None  # with state `FAILED`
    found: Mapping[str, Any] | None = None  # what `Finder.found` is


class Recipient(Protocol):
    """Takes the updates, and watches the thread that polls."""

    def send(self, update: SensorUpdate) -> bool:
        """Take an update. Return False if there are too many unread ones."""

    def allow(self, seconds: float) -> None:
        """Set the time limit until the next call."""

    def is_over(self, wait_s: float) -> bool:
        """Return True if polling is to end, after waiting for that for up to `wait_s`."""


class Polling:
    """Polls one sensor until the recipient ends it, the recording ends or the sensor fails permanently."""

    def __init__(
        self,
        make_driver: Callable[[], Sensor],
        settings: SensorSettings,
        clock: Clock,
        make_finder: Callable[[], Finder] | None,
        recipient: Recipient,
        *,
        keep_images: bool = False,
    ) -> None:
        """Store the arguments. `make_driver` does not open the device; `make_finder` is for drivers without eyes. With
        `keep_images`, samples keep their pictures.
        """
        self._make, self._settings, self._clock = make_driver, settings, clock
        self._make_finder, self._recipient, self._keep_images = make_finder, recipient, keep_images
        self._driver: Sensor | None = None
        self._finder: Finder | None = None
        self._unsent: deque[SensorFrame] = deque()
        self._latest, self._is_sent, self._serial, self._received = SensorUpdate(), True, "", False
        self._skipped = 0  # number of samples that were dropped, except by the current driver
        self._was_well = False  # True once the first valid sample has arrived
        self._delivered: dict[str, tuple[int, int]] = {}  # checksum and time of the last change, by kind of data
        self._untimely = ""  # description of the latest implausible capture time

    def run(self, *, serial: str = "", was_well: bool = False) -> None:
        """Poll the sensor with this serial number, if given. `was_well`: it has delivered before."""
        self._was_well, self._serial = was_well, serial
        wait_s = REOPEN_AFTER_S
        while self._attempt():
            self._recipient.allow(wait_s + HANG_MARGIN_S)
            if self._wait(wait_s):
                return
            wait_s = REOPEN_AFTER_S if self._received else min(2 * wait_s, REOPEN_AFTER_MAX_S)
        self._recipient.allow(FOREVER_S)
        while not self._wait(SEND_AGAIN_S):
            pass

    def _attempt(self) -> bool:
        """Open the sensor and poll it until it is lost. Return False if it is not to be opened again."""
        self._received = False
        try:
            self._recipient.allow(OPEN_TIMEOUT_S)
            self._driver = driver = self._make()
            driver.serial = driver.serial or self._serial
            driver.open()
            self._receive(driver)
        except _Over:
            return False
        except EndOfRecording as error:
            self._tell(SensorState.ENDED, str(error))
            return False
        except FatalError as error:
            if not is_retryable(error):
                self._tell(SensorState.FAILED, str(error), error)
                return False
            self._tell(SensorState.LOST, str(error))  # no descriptor or memory; may be temporary
        except TransientError as error:
            self._tell(SensorState.LOST, str(error))
        except (Exception, SystemExit) as error:  # an SDK may call `sys.exit()`
            if missing := missing_extra(error):
                self._tell(SensorState.FAILED, str(missing), missing)
                return False
            log.exception("sensor")
            self._tell(SensorState.LOST, f"{type(error).__name__}: {error}")
        finally:
            self._close()
        return True

    def _close(self) -> None:
        driver, self._driver = self._driver, None
        if driver is None:
            return
        self._recipient.allow(OPEN_TIMEOUT_S)
        try:
            driver.close()
        except (Exception, SystemExit):
            log.exception("sensor: error while closing")
        self._skipped += driver.skipped

    def _receive(self, driver: Sensor) -> None:
        """Read and send samples until the recipient ends it. Raises SensorLost if the device has failed, valid samples
        are late, or the data no longer change, FatalError if the first capture times are not on the run's clock, and
        EndOfRecording.
        """
        timeout_s = self._settings.timeout_s
        timeouts, well_ns, is_first = 0, self._clock.now_ns(), True
        if driver.capabilities.eye_points or self._make_finder is None:
            self._finder = None
        else:
            self._finder = self._make_finder()
        self._serial = driver.serial
        while not self._recipient.is_over(0.0):
            self._recipient.allow(timeout_s + HANG_MARGIN_S)
            try:
                frames = driver.read_arrived(timeout_s)
            except SensorTimeout as error:
                if driver.capabilities.may_pause:
                    continue
                timeouts += 1
                self._tell(SensorState.STALLED, str(error))
                if timeouts >= TIMEOUTS_TO_REOPEN:
                    raise SensorLost(
                        f"the sensor has not delivered any samples for {timeouts * timeout_s:g} s"
                    ) from error
                continue
            timeouts, now_ns = 0, self._clock.now_ns()
            if not (frames := self._timely(frames, now_ns)):
                if now_ns - well_ns > timeout_s * NS_PER_S:
                    raise SensorLost(self._untimely)
                continue
            well_ns, self._was_well = now_ns, True
            if not driver.capabilities.may_pause:
                self._check_changing(frames[-1], now_ns)
            # Find eyes only in the newest frame, because doing so takes as long as a camera's frame period.
            overtaken = 0 if self._finder is None else len(frames) - 1
            if self._finder is not None:
                self._recipient.allow(OPEN_TIMEOUT_S if is_first else timeout_s + HANG_MARGIN_S)
            for frame in frames[overtaken:]:
                self._keep(searched(frame, self._finder, keep_images=self._keep_images))
            self._received, is_first = True, False
            self._skipped += overtaken
            self._tell(SensorState.RUNNING)
        raise _Over

    def _timely(self, frames: list[SensorFrame], now_ns: int) -> list[SensorFrame]:
        """Return the frames with plausible capture times. Raises FatalError if the very first are implausible."""
        timely = [frame for frame in frames if -AHEAD_NS <= now_ns - frame.capture_ns <= BEHIND_NS]
        if len(timely) < len(frames):
            ahead_s = (frames[-1].capture_ns - now_ns) / NS_PER_S
            self._untimely = (
                f"the capture times are off by {ahead_s:+.3f} s; the driver must report times on the run's clock"
            )
            if not self._was_well:
                raise FatalError(self._untimely)
            self._skipped += len(frames) - len(timely)
        return timely

    def _check_changing(self, frame: SensorFrame, now_ns: int) -> None:
        """Check that the sensor's data keep changing, apart from missing eye points and empty depth. Raises SensorLost
        if pictures or eye points have stayed identical for more than `FROZEN_NS`.
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
        """Add a sample to those not sent yet. If there are too many, drop the oldest."""
        most = QUEUE_MAX if frame.colour is None and frame.depth_mm is None else PICTURES_MAX
        while len(self._unsent) >= most:
            self._unsent.popleft()
            self._skipped += 1
        self._unsent.append(frame)

    def _tell(self, state: SensorState, reason: str = "", error: FatalError | None = None) -> None:
        """Send the state and all unsent samples."""
        latest, driver = self._latest, self._driver
        if state != latest.state:
            log.info("sensor: %s%s", state, f" ({reason})" if reason else "")
        capabilities = latest.capabilities if driver is None else driver.capabilities
        skipped = self._skipped + (0 if driver is None else driver.skipped)
        found = self._finder.found if self._finder is not None and state is SensorState.RUNNING else None
        self._latest = SensorUpdate((), state, reason, self._serial, capabilities, skipped, error, found)
        self._is_sent = self._recipient.send(replace(self._latest, frames=tuple(self._unsent)))
        if self._is_sent:
            self._unsent.clear()

    def _wait(self, seconds: float) -> bool:
        """Wait, and send samples that did not fit before. Return True if polling is to end."""
        until_ns = self._clock.now_ns() + round(seconds * NS_PER_S)
        while (left_ns := until_ns - self._clock.now_ns()) > 0:
            if self._recipient.is_over(min(left_ns / NS_PER_S, SEND_AGAIN_S)):
                return True
            if not self._is_sent:
                self._tell(self._latest.state, self._latest.reason, self._latest.error)
        return False


class _Over(Exception):
    """The recipient has ended the polling."""
