"""Watches a run: keeps its last minutes, writes them when asked or at a fault, or writes all of it to a file.

The presenter's thread only puts what happened into a bounded queue; a thread of low priority makes messages and
pictures of it. Where it does not keep up, entries are lost and counted; the presenter never waits. On a simulated
clock nothing is lost: the presenter makes the messages itself.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from base64 import b64encode
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from runtime.blackbox.file import BlackBoxFile
from runtime.blackbox.messages import Message
from runtime.blackbox.pictures import Pictures, pictures_of, what_shows
from runtime.blackbox.ring import Ring
from runtime.blackbox.transcript import Entry, Logged, Refreshed, Sampled, Transcript, line_of
from runtime.clock import NS_PER_S, Clock
from runtime.errors import ContextLost, PhasestackError, one_line
from runtime.frame.presenter import Presenter, Refresh
from runtime.optics.stack import PanelStack
from runtime.records import SensorFrame
from runtime.sensor.recording_format import RecordingHeader
from runtime.support.background import Job
from runtime.support.logs import ROOTS
from runtime.support.priority import BACKGROUND_NICENESS, set_niceness
from runtime.support.waiting import wait_for

log = logging.getLogger("phasestack.blackbox")

QUEUED_MAX = 4096  # entries: some 40 s of refreshes and samples
IMAGES_QUEUED_MAX = 64  # the same where samples carry pictures
TURN_S = 0.05
KEPT_PICTURES_EVERY_NS = NS_PER_S  # in memory
FILE_PICTURES_EVERY_NS = NS_PER_S // 4
ASKED_PICTURES_EVERY_NS = NS_PER_S // 2
ASKED_FOR_NS = 3 * NS_PER_S  # pictures are made so long after somebody has asked for them
AFTER_FAULT_NS = 5 * NS_PER_S  # what follows a fault is in its black box too
FAULTS_APART_NS = 60 * NS_PER_S  # a fault that repeats does not fill the disk
WRITTEN_WITHIN_S = 5.0
LINES_KEPT, STATES_KEPT = 200, 50  # for who looks in
MIB = 1 << 20


class _Line:
    """A log line for who looks in: put into words when it is first asked for, not by who logs."""

    def __init__(self, record: logging.LogRecord) -> None:
        self._record = record

    @cached_property
    def told(self) -> dict[str, Any]:
        record = self._record
        text = one_line(line_of(record))
        return {"time_s": round(record.created, 3), "level": record.levelname.lower(), "text": text}


@dataclass(frozen=True, slots=True)
class Plan:
    """What is recorded, and where to."""

    minutes: float = 0.0  # that are kept in memory; 0: none
    most_bytes: int = 32 * MIB  # of what is kept in memory
    folder: Path = Path()
    files: int = 10  # that are kept in the folder; the oldest make way
    record: Path | None = None  # all the way, to this file
    record_bytes: int = 2048 * MIB
    images: bool = False  # the sensor's pictures too: faces


class Recorder:
    """An observer of a run. `watches` begins; `close` ends it."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._queue: deque[Entry] = deque()
        self._most = IMAGES_QUEUED_MAX if plan.images else QUEUED_MAX
        self.lost = 0
        self._latest: Refresh | None = None
        self._presenter: Presenter | None = None
        self._transcript: Transcript | None = None
        self._ring = Ring(most_s=60.0 * plan.minutes, most_bytes=plan.most_bytes) if plan.minutes > 0 else None
        self._file: BlackBoxFile | None = None
        self._saves: deque[tuple[str, Callable[[str, Path | None], None]]] = deque()  # asked for, and who to tell
        self._job: Job[None] | None = None
        self._fault_ns: int | None = None  # a fault waits for what follows it
        self._saved_ns = -FAULTS_APART_NS
        self._was_degraded = False
        self._pictured_ns = -NS_PER_S
        self._pictured_frame = -1
        self._pictured: Any = None  # what the newest pictures show
        self._asked_ns = -ASKED_FOR_NS
        self.pictures: Pictures | None = None  # the newest
        self._lines: deque[_Line] = deque(maxlen=LINES_KEPT)
        self._passed: deque[dict[str, Any]] = deque(maxlen=STATES_KEPT)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._tap: _LogTap | None = None
        self.last_file: Path | None = None  # that was written because of a fault, or asked for

    def watches(self, presenter: Presenter, *, stack: PanelStack, simulated: bool, in_stack_frame: bool) -> None:
        """Begin, with a run that is about to. Raises InputError where the file to record to can't be written."""
        self._presenter, self._stack, self._simulated = presenter, stack, simulated
        self._clock: Clock = presenter.clock
        state = presenter.run_cell.state
        self._transcript = Transcript(
            stack,
            state.settings,
            stack_from_sensor=state.calibration.stack_from_sensor,
            in_stack_frame=in_stack_frame,
            images=self._plan.images,
        )
        now_ns = self._clock.now_ns()
        self._transcript.set_clock(monotonic_ns=now_ns, wall_ns=time.time_ns())
        if self._plan.record is not None:
            self._file = BlackBoxFile(self._plan.record, self._header(), why="record", settings=self._settings())
            self._file.write_all(self._transcript.standing(at_ns=now_ns))
        self._tap = _LogTap(self._logged)
        for name in ROOTS:
            logging.getLogger(name).addHandler(self._tap)
        if not simulated:
            self._thread = threading.Thread(target=self._run, name="black box", daemon=True)
            self._thread.start()

    # On the presenter's thread.

    def sampled(self, sample: SensorFrame) -> None:
        self._put(Sampled(self._clock.now_ns(), sample))

    def refreshed(self, refresh: Refresh) -> None:
        assert self._presenter is not None
        machine = self._presenter.machine
        self._latest = refresh
        self._put(Refreshed(refresh.account, machine.name, machine.reason))
        if self._simulated:
            self._turn()

    def _logged(self, record: logging.LogRecord) -> None:
        """On whichever thread logs."""
        self._lines.append(_Line(record))
        self._put(Logged(self._clock.now_ns(), record))

    def _put(self, entry: Entry) -> None:
        if len(self._queue) < self._most or (self._thread is None and self._transcript is not None):
            self._queue.append(entry)
        else:
            self.lost += 1

    # On any thread.

    def save(self, why: str, told: Callable[[str, Path | None], None] = lambda problem, path: None) -> None:
        """Write what is kept to a file as the run goes on. told: why not (empty: done), and the file; from a thread."""
        if self._ring is None:
            told("nothing is kept in memory (service.blackbox_minutes is 0)", None)
            return
        self._saves.append((why, told))

    def look_at_pictures(self) -> dict[str, Any]:
        """The newest pictures, JPEG in base64; from now on they are made for some seconds."""
        self._asked_ns = time.monotonic_ns()
        made = self.pictures
        if made is None:
            return {"frame": None, "jpegs": {}}
        return {"frame": made.frame, "jpegs": {name: b64encode(jpeg).decode() for name, jpeg in made.jpegs.items()}}

    def look_at_log(self) -> dict[str, Any]:
        """The newest log lines and states, the oldest first; times since 1970."""
        return {"lines": [line.told for line in list(self._lines)], "states": list(self._passed)}

    def describe(self) -> dict[str, Any]:
        """For the status."""
        ring, file = self._ring, self._file
        return {
            "kept_s": round(ring.seconds, 1) if ring is not None else None,
            "kept_mib": round(ring.bytes_held / MIB, 2) if ring is not None else None,
            "recording": str(file.path) if file is not None else None,
            "lost": self.lost,
            "last_file": str(self.last_file) if self.last_file is not None else None,
        }

    def close(self, *, crashed: str = "") -> None:
        """No more; crashed: why the run ended with an error: what is kept is written. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        if self._tap is not None:
            for name in ROOTS:
                logging.getLogger(name).removeHandler(self._tap)
            self._tap = None
        if self._transcript is None:
            return
        with contextlib.suppress(Exception):
            self._drain()
        if self._job is not None:
            wait_for(lambda: self._job is None or self._job.done, timeout_s=WRITTEN_WITHIN_S)
        if crashed and self._ring is not None:
            self._write(f"error: {crashed}", lambda *_: None)
        elif self._fault_ns is not None:
            self._write("fault", lambda *_: None)
        while self._saves:
            self._write(*self._saves.popleft())
        if self._file is not None:
            file, self._file = self._file, None
            try:
                file.finish()
            except OSError as error:
                log.error("%s: the recording could not be finished (%s)", file.path, error.strerror)
        self._transcript = None

    # On the recorder's thread.

    def _run(self) -> None:
        set_niceness(BACKGROUND_NICENESS)
        while not self._stop.wait(TURN_S):
            try:
                self._turn()
            except Exception:
                log.exception("the black box's turn failed")

    def _turn(self) -> None:
        if not self._simulated:
            assert self._transcript is not None
            self._transcript.set_clock(monotonic_ns=self._clock.now_ns(), wall_ns=time.time_ns())
        self._drain()
        self._make_pictures()
        now_ns = self._clock.now_ns()
        if self._fault_ns is not None and now_ns - self._fault_ns >= AFTER_FAULT_NS:
            self._fault_ns, self._saved_ns = None, now_ns
            self.save("fault")
        if self._saves and (self._job is None or self._job.done):
            self._begin_writing(*self._saves.popleft())

    def _drain(self) -> None:
        assert self._transcript is not None
        while self._queue:
            entry = self._queue.popleft()
            if isinstance(entry, Refreshed):
                self._notice(entry)
            for message in self._transcript.of(entry, lost=self.lost):
                self._keep(message)
        self._flush()

    def _notice(self, entry: Refreshed) -> None:
        degraded = entry.account.state == "degraded"
        at_ns = entry.account.present_ns
        begins = degraded and not self._was_degraded and self._fault_ns is None and self._ring is not None
        if begins and at_ns - self._saved_ns >= FAULTS_APART_NS:
            self._fault_ns = at_ns
        self._was_degraded = degraded
        if not self._passed or self._passed[-1]["state"] != entry.state:
            assert self._transcript is not None
            time_s = self._transcript.wall_ns(at_ns) / NS_PER_S
            self._passed.append({"time_s": round(time_s, 3), "state": entry.state, "reason": entry.reason})

    def _keep(self, message: Message) -> None:
        if self._ring is not None:
            self._ring.add(message, at_ns=self._clock.now_ns())
        if self._file is not None:
            self._to_file(lambda file: file.write(message))

    def _flush(self) -> None:
        if self._file is None:
            return
        self._to_file(BlackBoxFile.flush)
        if self._file is not None and self._file.bytes_written > self._plan.record_bytes:
            log.warning("%s: is as large as it may be (sensor.record_max_mib): it ends here", self._file.path)
            self._to_file(BlackBoxFile.finish)
            self._file = None

    def _to_file(self, do: Callable[[BlackBoxFile], None]) -> None:
        assert self._file is not None
        try:
            do(self._file)
        except OSError as error:
            log.error("%s: cannot be written (%s): it ends here", self._file.path, error.strerror)
            self._file.abandon()  # what was flushed stays: it is read up to the break
            self._file = None

    def _make_pictures(self) -> None:
        latest, now_ns = self._latest, self._clock.now_ns()
        every_ns = self._pictures_every_ns()
        if latest is None or every_ns is None or now_ns - self._pictured_ns < every_ns:
            return
        if latest.account.frame == self._pictured_frame:
            return
        self._pictured_ns, self._pictured_frame = now_ns, latest.account.frame
        shows = what_shows(latest)
        if self.pictures is not None and shows == self._pictured:  # of a resting head, of a flat picture: the same
            account = latest.account
            self.pictures = made = replace(self.pictures, frame=account.frame, time_ns=account.present_ns)
        else:
            try:
                self.pictures = made = pictures_of(latest, self._stack)
            except ContextLost:  # its layers were in textures: the next refresh has others
                return
        self._pictured = shows
        del latest
        if self._transcript is not None:
            for message in self._transcript.of(made, lost=self.lost):
                self._keep(message)

    def _pictures_every_ns(self) -> int | None:
        wanted = []
        if self._ring is not None:
            wanted.append(KEPT_PICTURES_EVERY_NS)
        if self._file is not None:
            wanted.append(FILE_PICTURES_EVERY_NS)
        if time.monotonic_ns() - self._asked_ns < ASKED_FOR_NS:
            wanted.append(ASKED_PICTURES_EVERY_NS)
        return min(wanted, default=None)

    def _header(self) -> RecordingHeader:
        assert self._presenter is not None
        driver = self._presenter.run_cell.state.settings.sensor.driver
        images = self._plan.images
        return RecordingHeader(driver, self._presenter.samples.serial, colour=images, depth=images)

    def _settings(self) -> str:
        """Those in force, as JSON."""
        assert self._presenter is not None
        return self._presenter.run_cell.state.settings.model_dump_json()

    def _begin_writing(self, why: str, told: Callable[[str, Path | None], None]) -> None:
        work = self._writing(why, told)
        self._job = Job("black box file", work)

    def _write(self, why: str, told: Callable[[str, Path | None], None]) -> None:
        self._writing(why, told)()

    def _writing(self, why: str, told: Callable[[str, Path | None], None]) -> Callable[[], None]:
        """What writes all that is kept now."""
        assert self._ring is not None and self._transcript is not None
        held = self._ring.held()
        at_ns = held[0].wall_ns - self._transcript.wall_ns(0) if held else self._clock.now_ns()
        standing = self._transcript.standing(at_ns=at_ns)
        header, settings, plan = self._header(), self._settings(), self._plan

        def work() -> None:
            try:
                path = _written(plan.folder, [*standing, *held], header, why=why, settings=settings)
                _make_room(plan.folder, plan.files)
            except (PhasestackError, OSError) as error:
                log.error("the black box could not be written: %s", one_line(str(error)))
                told(str(error), None)
                return
            self.last_file = path
            log.info("black box written: %s (%s)", path, why, extra={"always": True})
            told("", path)

        return work


def _written(folder: Path, messages: list[Message], header: RecordingHeader, *, why: str, settings: str) -> Path:
    """A new file in a folder, whole or not there. Raises InputError, OSError."""
    stem = f"blackbox-{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{os.getpid()}"
    path = next(path for n in range(1000) if not (path := folder / f"{stem}{f'-{n}' if n else ''}.mcap").exists())
    file = BlackBoxFile(path, header, why=why, settings=settings)
    try:
        file.write_all(messages)
        file.finish()
    except BaseException:
        file.abandon()
        raise
    return path


def _make_room(folder: Path, files: int) -> None:
    """The oldest black boxes make way."""
    for path in sorted(folder.glob("blackbox-*.mcap"))[:-files]:
        path.unlink(missing_ok=True)


class _LogTap(logging.Handler):
    """Hands every log line on."""

    def __init__(self, put: Callable[[logging.LogRecord], None]) -> None:
        super().__init__()
        self._hand_on = put

    def emit(self, record: logging.LogRecord) -> None:
        self._hand_on(record)
