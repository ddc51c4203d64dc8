"""Black box that writes a run's last few minutes to an MCAP file, on request or after a fault.

Every few seconds, new messages are appended to a journal on disk. When a run ends normally, its journal is deleted. If
the run is ended by a power cut or killed, the next run finds the journal and renames it as a file of kind `cut`.

The files can also be used as recordings: `run --replay` plays back their samples through the same code. Messages are
serialised as they arrive, so that the garbage collector never has to visit them. The files are written by a background
job.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Self

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.errors import InputError, Stopped, one_line, without_secrets
from runtime.frame.presenter import Presenter
from runtime.frame.refresh import Refresh
from runtime.frame.refresh_lines import line_of
from runtime.records import F64, RefreshAccount, SensorFrame
from runtime.sensor import recording_format as fmt
from runtime.sensor.recording_format import RecordingHeader
from runtime.support.artifacts import put_in_place, to_json
from runtime.support.background import BackgroundJob
from runtime.support.logs import ROOTS
from runtime.support.version import version

log = logging.getLogger("phasestack.blackbox")

Saved = Callable[[str, Path | None], None]  # called with an error message (empty on success) and the file

BYTES_MAX = 32 << 20  # limit for all messages kept in memory
OVERHEAD_BYTES = 150  # memory needed for a message in addition to its data
AFTER_FAULT_NS = 5 * NS_PER_S  # how long to keep recording after a fault before writing the file
FAULTS_APART_NS = 60 * NS_PER_S  # minimum time between files of one kind, so that repeated faults do not fill the disk
STATE_EVERY_NS = NS_PER_S  # interval between state messages while the state stays the same
WRITTEN_WITHIN_S = 5.0  # how long to wait for the last file at the end of a run
JOURNAL_EVERY_NS = 3 * NS_PER_S  # at most this much is lost in a power cut, plus one chunk
CHUNK_BYTES = 16384  # the journal's chunk size
CUT = "cut"  # kind of file recovered from a journal
LINES_KEPT, STATES_KEPT = 200, 50  # how many log lines and states are kept for the operator's page
FILES_MAX = 20  # maximum number of files kept in the folder
PREFIX = "blackbox-"
ASKED = "asked"  # kind of file requested by an operator
JOURNAL = "journal"
PART = ".part"  # suffix of an unfinished file

LOG, REFRESH, STATE = "/log", "/refresh", "/state"
# Viewers can plot any number. A schema with field names is needed only for topics that they display in a special way.
SCHEMAS: dict[str, dict[str, Any]] = {
    **fmt.SCHEMAS,
    LOG: {
        "title": "foxglove.Log",
        "type": "object",
        "properties": {
            "timestamp": {"type": "object"},
            "level": {"type": "integer"},
            "message": {"type": "string"},
            "name": {"type": "string"},
        },
    },
    REFRESH: {"title": "phasestack.Refresh", "type": "object"},
    STATE: {"title": "phasestack.State", "type": "object"},
}


def refresh_message(account: RefreshAccount) -> bytes:
    """Return a refresh as JSON: its line in `frames.jsonl`, plus the display time and latency."""
    latency_ms = None
    if account.eyes_m is not None and account.capture_ns:
        latency_ms = round((account.photon_ns - account.capture_ns) / NS_PER_MS, 4)
    return to_json(line_of(account) | {"photon_ns": account.photon_ns, "capture_to_light_ms": latency_ms}).encode()


def state_message(name: str, reason: str, *, monotonic_ns: int) -> bytes:
    """Return a state as JSON, including the missing parts from a name such as `degraded: sensor, panel`."""
    plain, _, missing = name.partition(": ")
    parts = missing.split(", ") if missing else []
    return to_json({"monotonic_ns": monotonic_ns, "state": plain, "missing": parts, "reason": reason}).encode()


def log_message(record: logging.LogRecord) -> bytes:
    """Return a log record as JSON, in the format used for Foxglove log messages."""
    seconds, nanoseconds = divmod(round(record.created * NS_PER_S), NS_PER_S)
    line = {
        "timestamp": {"sec": seconds, "nsec": nanoseconds},
        "level": record.levelno // 10,  # a Foxglove level is the Python level divided by ten
        "message": text_of(record),
        "name": record.name,
    }
    return to_json(line).encode()


def text_of(record: logging.LogRecord) -> str:
    """Return a log record's message and exception on one line."""
    text = record.getMessage()
    if record.exc_info and record.exc_info[1] is not None:
        text += f": {type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
    return one_line(text)


class BlackBoxMessage(NamedTuple):
    """A message kept by the black box, serialised as in its files."""

    at_ns: int  # time on the run's clock; the wall clock may be set back
    wall_ns: int  # wall-clock time since 1970
    topic: str
    data: bytes  # JSON
    sequence: int  # sample or refresh number, modulo 2^32; 0 for other messages


class Recorder(logging.Handler):
    """Records a run's samples, refreshes, states and log, from `watches` to `close`. The observer methods
    are called on the presenter's thread. Any thread may log. Each file is written by a background job.
    """

    def __init__(self, folder: Path, *, minutes: float) -> None:
        """Prepare the folder, and recover the journal if the last run was killed. 0 minutes keep and write nothing."""
        super().__init__()
        self._folder, self._most_ns = folder, round(60 * minutes * NS_PER_S)
        self._kept_lock = threading.Lock()
        self._kept: deque[BlackBoxMessage] = deque()
        self._bytes = 0
        self._presenter: Presenter | None = None
        self._sensor_from_stack: F64 | None = None
        self._state, self._state_ns = ("", ""), 0
        self._fault: tuple[int, str] | None = None  # start and kind of a fault not yet written to a file
        self._faults_ns: dict[str, int] = {}  # time of the latest fault of each kind
        self._recorded: dict[str, dict[str, Any]] = {}  # entry in `_faulty` of the latest fault of each kind
        self._last_file: Path | None = None
        self._lines: deque[dict[str, Any]] = deque(maxlen=LINES_KEPT)
        self._passed: deque[dict[str, Any]] = deque(maxlen=STATES_KEPT)
        self._faulty: deque[dict[str, Any]] = deque(maxlen=STATES_KEPT)  # the faults among them, with their files
        self._waiting_lock, self._is_writing = threading.Lock(), False
        self._waiting: dict[str, list[Saved]] = {}  # requests for files not yet started by the writer, by kind
        self._writer: BackgroundJob[None] | None = None
        self._fresh = 0  # how many of the newest messages are not in the journal yet
        self._journal, self._journaled_ns = _Journal(folder), 0
        self._journaling: BackgroundJob[None] | None = None
        if self._most_ns:
            import mcap.writer  # noqa: F401 - fails at the start if mcap is not installed

            _find_cut(folder)
            make_room(folder)
        _sweep(folder)

    def watches(self, presenter: Presenter, *, in_stack_frame: bool) -> None:
        """Start recording a presenter, always in the `sensor` frame, even if samples arrive in `stack`."""
        self._presenter = presenter
        if in_stack_frame:
            self._sensor_from_stack = np.asarray(np.linalg.inv(presenter.viewer.calibration.stack_from_sensor))
        for name in ROOTS:
            logging.getLogger(name).addHandler(self)

    def sampled(self, sample: SensorFrame) -> None:
        matrix = self._sensor_from_stack
        if sample.eyes is not None and matrix is not None:
            moved = (each.eyes_m @ matrix[:3, :3].T + matrix[:3, 3] for each in sample.people)
            people = zip(sample.people, moved, strict=True)
            first, *others = (replace(each, eyes_m=eyes_m, covariance_m2=None) for each, eyes_m in people)
            sample = replace(sample, eyes=first, others=tuple(others))
        self._keep(fmt.EYES_TOPIC, fmt.eyes_message(sample), sample.sequence)

    def refreshed(self, refresh: Refresh) -> None:
        assert self._presenter is not None
        account, status = refresh.account, self._presenter.status
        assert status is not None
        at_ns, state = account.present_ns, (status.name, status.reason)
        if state != self._state or at_ns - self._state_ns >= STATE_EVERY_NS:
            if status.name != self._state[0]:
                self._state_changed(*state, at_ns)
            self._state, self._state_ns = state, at_ns
            self._keep(STATE, state_message(*state, monotonic_ns=at_ns))
        self._keep(REFRESH, refresh_message(account), account.frame)
        is_due = at_ns - self._journaled_ns >= JOURNAL_EVERY_NS
        if self._most_ns and is_due and (self._journaling is None or self._journaling.done):
            self._journaled_ns = at_ns
            with self._kept_lock:
                fresh = list(islice(reversed(self._kept), self._fresh))[::-1]
                self._fresh = 0
            # The journal is written in the background, because a refresh must not wait for the disk.
            work = partial(self._journal.add, fresh, *_head(self._presenter), most_ns=self._most_ns)
            self._journaling = BackgroundJob("black box's journal", work)
        if self._fault is not None and at_ns - self._fault[0] >= AFTER_FAULT_NS:
            kind, self._fault = self._fault[1], None
            self.save(kind)

    def _state_changed(self, name: str, reason: str, at_ns: int) -> None:
        self._passed.append({"time_s": round(time.time(), 3), "state": name, "reason": reason})
        if name.startswith("degraded"):
            self._faulty.append(self._passed[-1] | {"file": None})
        was_well = self._state[0].partition(":")[0] not in ("", "starting", "degraded")  # a slow startup is not a fault
        if not name.startswith("degraded") or not was_well or self._fault is not None or not self._most_ns:
            return
        kind = "fault-" + name.partition(": ")[2].replace(", ", "+")
        if at_ns - self._faults_ns.get(kind, -FAULTS_APART_NS) >= FAULTS_APART_NS:
            self._fault, self._faults_ns[kind] = (at_ns, kind), at_ns
            self._recorded[kind] = self._faulty[-1]

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a log record. Called on any thread."""
        line = {"time_s": round(record.created, 3), "level": record.levelname.lower()}
        self._lines.append(line | {"text": text_of(record)})
        self._keep(LOG, log_message(record))

    def _keep(self, topic: str, data: bytes, sequence: int = 0) -> None:
        assert self._presenter is not None
        at_ns = self._presenter.clock.now_ns()
        with self._kept_lock:
            self._kept.append(BlackBoxMessage(at_ns, time.time_ns(), topic, data, sequence & 0xFFFFFFFF))
            self._fresh += 1
            self._bytes += len(data) + OVERHEAD_BYTES
            while self._kept and (self._bytes > BYTES_MAX or at_ns - self._kept[0].at_ns > self._most_ns):
                self._bytes -= len(self._kept.popleft().data) + OVERHEAD_BYTES
            self._fresh = min(self._fresh, len(self._kept))  # limits the memory used if the journal hangs

    def save(self, kind: str, saved: Saved = lambda problem, path: None) -> None:
        """Write all messages to a file named by `kind` in the background, then call `saved` with a problem or
        "", and the file. Requests of the same kind that arrive before their file has been started share it.
        """
        if not self._most_ns or self._presenter is None:
            saved("the black box is switched off; set service.blackbox_minutes above 0", None)
            return
        with self._waiting_lock:
            self._waiting.setdefault(kind, []).append(saved)
            if self._is_writing:
                return
            self._writer = BackgroundJob("black box", partial(self._write, self._presenter))
            self._is_writing = not self._writer.problem
            if self._is_writing:
                return
            del self._waiting[kind]
        saved(self._writer.problem, None)

    def _write(self, presenter: Presenter) -> None:
        """On the writer's thread, write all requested files in the order they were first requested."""
        while True:
            with self._waiting_lock:
                self._is_writing = bool(self._waiting)
                if not self._waiting:
                    return
                kind = next(iter(self._waiting))
                listeners = self._waiting.pop(kind)
            with self._kept_lock:
                kept = list(self._kept)
            problem = ""
            try:
                self._last_file = write_file(self._folder, kind, kept, *_head(presenter))
                log.info("black box written: %s", self._last_file, extra={"always": True})
                self._recorded.get(kind, {})["file"] = str(self._last_file)
                make_room(self._folder)
            except OSError as error:
                log.error("the black box could not be written: %s", error)
                problem = f"{self._folder}: cannot be written: {error.strerror}"
            for saved in listeners:
                saved(problem, None if problem else self._last_file)

    def look_at_log(self) -> dict[str, Any]:
        """Return the latest log lines, states and faults, oldest first, with times in seconds since 1970."""
        return {"lines": list(self._lines), "states": list(self._passed), "faults": list(self._faulty)}

    def describe(self) -> dict[str, Any]:
        """Return the black box's entry in the daemon's status."""
        with self._kept_lock:
            kept_ns = self._kept[-1].at_ns - self._kept[0].at_ns if self._kept else 0
            kept_bytes = self._bytes
        return {
            "kept_s": round(kept_ns / NS_PER_S, 1),
            "kept_mib": round(kept_bytes / (1 << 20), 2),
            "last_file": str(self._last_file) if self._last_file is not None else None,
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the recorder. After an unexpected error, write all kept messages to a file first."""
        if isinstance(error, Exception) and not isinstance(error, Stopped | InputError) and self._presenter is not None:
            log.error("%s", one_line(f"{type(error).__name__}: {error}"))
            self._fault = (0, "error")
        self.close()

    def close(self) -> None:
        """Stop recording and finish any pending files. May be called more than once."""
        for name in ROOTS:
            logging.getLogger(name).removeHandler(self)
        if self._fault is not None:
            self.save(self._fault[1])
        self._fault = None
        for job in (self._writer, self._journaling):
            if job is not None:
                job.wait(WRITTEN_WITHIN_S)
        if self._writer is None or self._writer.done:  # if not, keep the journal for the next run
            self._journal.close(in_use=self._journaling is not None and not self._journaling.done)
        self._presenter = None
        super().close()


def _head(presenter: Presenter) -> tuple[RecordingHeader, str]:
    """Return the recording header, and the settings as JSON, to be written before a file's messages."""
    settings = presenter.settings
    header = RecordingHeader(settings.sensor.driver, presenter.samples.serial)
    return header, without_secrets(settings.model_dump_json())


def write_file(folder: Path, kind: str, kept: list[BlackBoxMessage], header: RecordingHeader, settings: str) -> Path:
    """Write messages to a new file, atomically, and return its path. Raises OSError if that fails. The
    file can be read only by its owner, because it shows how viewers moved. The number in its name is higher than any
    other in the folder, because dates may be wrong if the wall clock has been set back.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = _next_name(folder, kind, datetime.now(UTC))
    part = path.with_name(f".{path.name}{PART}")
    with _opened(part) as file:
        try:
            written = _Written(file, header, settings)
            written.add(kept)
            written.writer.finish()
            file.flush()
            put_in_place(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    return path


def _next_name(folder: Path, kind: str, at: datetime) -> Path:
    others = (*folder.glob(f"{PREFIX}*.mcap"), *folder.glob(f".{PREFIX}*{PART}"))
    number = 1 + max(map(_number, others), default=0)
    return folder / f"{PREFIX}{number:06}-{at:%Y%m%dT%H%M%SZ}-{kind}.mcap"


def _opened(part: Path) -> IO[bytes]:
    file = os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600), "wb")
    fcntl.flock(file, fcntl.LOCK_EX)  # `_sweep` deletes any partial file that is not locked
    return file


class _Written:
    """Writes messages to an open MCAP file."""

    def __init__(self, file: IO[bytes], header: RecordingHeader, settings: str) -> None:
        from mcap.writer import CompressionType, Writer

        self.writer: Any = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self.writer.start(profile="phasestack", library=f"phasestack {version()}")
        self.writer.add_metadata(fmt.METADATA_NAME, header.metadata())
        self.writer.add_attachment(0, 0, "settings.json", "application/json", settings.encode())
        self._channels: dict[str, int] = {}

    def add(self, messages: list[BlackBoxMessage]) -> None:
        for message in messages:
            topic = message.topic
            if topic not in self._channels:
                schema = SCHEMAS[topic]
                number = self.writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
                self._channels[topic] = self.writer.register_channel(topic, "json", number)
            at_ns = message.wall_ns
            self.writer.add_message(self._channels[topic], at_ns, message.data, at_ns, message.sequence)


class _Journal:
    """A journal of the most recent messages on disk, which alternates between two files. Each file holds at most half
    the time and half the bytes kept by the black box.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._current, self._begun_ns = folder, 0, 0
        self._file: IO[bytes] | None = None
        self._written: _Written | None = None

    def add(self, fresh: list[BlackBoxMessage], header: RecordingHeader, settings: str, *, most_ns: int) -> None:
        """Write messages to disk immediately. If this fails, the journal ends but the run continues."""
        now_ns = time.monotonic_ns()
        try:
            if self._file is None or now_ns - self._begun_ns > most_ns // 2 or self._file.tell() > BYTES_MAX // 2:
                self._current, self._begun_ns = 1 - self._current, now_ns
                if self._file is not None:
                    self._file.close()
                self._folder.mkdir(parents=True, exist_ok=True)
                self._path.unlink(missing_ok=True)
                self._file = _opened(self._path)
                self._written = _Written(self._file, header, settings)
            assert self._written is not None
            self._written.add(fresh)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            log.warning("cannot write the black box's journal: %s", error.strerror)
            self.close()

    @property
    def _path(self) -> Path:
        return self._folder / f".{PREFIX}{JOURNAL}{self._current}{PART}"

    def close(self, *, in_use: bool = False) -> None:
        """Delete the journal after the run has ended normally, without closing a file that is still `in_use`."""
        if self._file is not None and not in_use:
            with suppress(OSError):
                self._file.close()
            self._file = None
        for self._current in (0, 1):
            with suppress(OSError):
                self._path.unlink(missing_ok=True)


def _find_cut(folder: Path) -> None:
    """If a run was killed, rename its journals as permanent files."""
    for journal in sorted(folder.glob(f".{PREFIX}{JOURNAL}*{PART}"), key=lambda path: path.stat().st_mtime):
        with suppress(OSError), journal.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            at = datetime.fromtimestamp(journal.stat().st_mtime, UTC)
            journal.rename(path := _next_name(folder, CUT, at))
            log.warning("the previous run did not exit cleanly; its last minutes are in %s", path)


def make_room(folder: Path) -> None:
    """Delete files of the most common kind until at most `FILES_MAX` are left in the folder. The newest
    file in the folder is kept. The first file of any kind is deleted only after all others of that kind.
    """
    kinds: dict[str, list[Path]] = {}
    *earlier, _ = sorted(folder.glob(f"{PREFIX}*.mcap"), key=lambda path: (_number(path), path.name)) or [folder]
    for file in earlier:
        kinds.setdefault(file.stem.partition("Z-")[2].partition("~")[0], []).append(file)
    for _ in range(len(earlier) + 1 - FILES_MAX):
        largest = max(kinds.values(), key=len)
        largest.pop(1 if len(largest) > 1 else 0).unlink(missing_ok=True)
    _sweep(folder)


def _number(path: Path) -> int:
    """Return the number in a file's name, or 0."""
    first = path.name.removeprefix(".").removeprefix(PREFIX).partition("-")[0]
    return int(first) if first.isdecimal() else 0


def _sweep(folder: Path) -> None:
    """Delete unfinished files from killed processes."""
    for part in folder.glob(f".{PREFIX}*{PART}"):
        with suppress(OSError), part.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            part.unlink()
