"""Recordings as MCAP files of small chunks, so that complete samples remain readable after a crash."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from runtime.clock import NS_PER_S
from runtime.errors import InputError
from runtime.records import Intrinsics, SensorFrame
from runtime.sensor import recording_format as fmt
from runtime.sensor.recording_format import RecordingHeader
from runtime.support import untrusted_input
from runtime.support.artifacts import put_in_place
from runtime.support.background import BackgroundJob
from runtime.support.untrusted_input import LIMITS, MIB

CHUNK_BYTES = 4096  # chunk size: about 20 samples of eye points
INDEX_SHARE = 1.1  # ratio of a file's size with chunk indices to its size without them
SUMMARY_BYTES = 10_000  # size of a file's summary, schemas included
MAX_S, MAX_BYTES = 600.0, 2 << 30  # limits for a recording
MAGIC = b"\x89MCAP0\r\n"
CHUNK = b"\x06"  # first byte of a chunk
WINDOW_BYTES = 1 << 27  # maximum zstandard window size
NEEDED = (
    "replay requires it and the topic `/eyes`; to play other recordings, write your own driver (see docs/sensors.md)"
)
KINDS = {  # hints for other file types, keyed by their first bytes
    b"#ROSBAG ": " but a ROS 1 bag; convert it with `mcap convert`",
    b"SQLite f": " but a ROS 2 bag in SQLite; convert it with `ros2 bag convert`",
    b"version ": " but a Git LFS pointer; fetch the file itself with `git lfs pull`",
}

SYNCED_WITHIN_S = 30.0  # maximum wait for a slow disk when a recording is finished
SYNC_EVERY_NS = 2 * NS_PER_S  # amount of data that may be lost in a power cut, if the disk is fast enough

log = logging.getLogger(__name__)


class RecordingWriter:
    """Writer that appends samples to an open binary file, up to limits on duration and size."""

    def __init__(
        self,
        file: IO[bytes],
        header: RecordingHeader,
        *,
        max_s: float = MAX_S,
        on_first: Callable[[], object] = lambda: None,
    ) -> None:
        """Write the beginning of an empty binary file, which the caller closes. Colour and depth are written if the
        header has them, for at most `max_s`. `on_first` is called after the first sample.
        """
        from mcap.writer import CompressionType, IndexType, Writer

        self._file, self._max_ns, self._on_first = file, round(max_s * NS_PER_S), on_first
        self._header, has_images = header, header.colour or header.depth
        # Without compression, eye-point files do not depend on a library's version.
        compression = CompressionType.LZ4 if has_images else CompressionType.NONE
        index = IndexType.CHUNK | IndexType.METADATA
        self._writer: Any = Writer(file, chunk_size=CHUNK_BYTES, compression=compression, index_types=index)
        self._writer.start(profile="phasestack", library="phasestack")
        self._writer.add_metadata(fmt.METADATA_NAME, header.metadata())
        self._channels: dict[str, int] = {}
        self.count = 0
        self._first_ns: int | None = None
        self._sync: BackgroundJob[None] | None = None
        self._synced_ns = time.monotonic_ns()
        self._intrinsics: Intrinsics | None = None

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            schema = fmt.SCHEMAS[topic]
            number = self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        return self._channels[topic]

    def write(self, frame: SensorFrame) -> bool:
        """Append a sample, pictures first. Returns False, and writes nothing, beyond the duration or size."""
        at, header = frame.capture_ns, self._header
        messages: list[tuple[str, bytes]] = []
        has_images = header.colour or header.depth
        if has_images and frame.intrinsics is not None and frame.intrinsics != self._intrinsics:
            messages.append((fmt.CALIBRATION_TOPIC, fmt.calibration_message(frame.intrinsics, capture_ns=at)))
        if header.colour and frame.colour is not None:
            messages.append((fmt.COLOUR_TOPIC, fmt.colour_message(frame.colour, capture_ns=at)))
        if header.depth and frame.depth_mm is not None:
            messages.append((fmt.DEPTH_TOPIC, fmt.depth_message(frame.depth_mm, capture_ns=at)))
        messages.append((fmt.EYES_TOPIC, fmt.eyes_message(frame)))
        first_ns = at if self._first_ns is None else self._first_ns
        written = self._file.tell() + CHUNK_BYTES + sum(len(data) for _, data in messages)
        if at - first_ns > self._max_ns or INDEX_SHARE * written + SUMMARY_BYTES > MAX_BYTES:
            return False
        for topic, data in messages:
            self._writer.add_message(self._channel(topic), at, data, at, frame.sequence & 0xFFFFFFFF)
        self._file.flush()
        self._first_ns, self._intrinsics = first_ns, frame.intrinsics or self._intrinsics
        self.count += 1
        if self.count == 1:
            self._on_first()
        if time.monotonic_ns() - self._synced_ns >= SYNC_EVERY_NS and (self._sync is None or self._sync.done):
            self._synced_ns = time.monotonic_ns()
            # Synchronize in the background, because a slow disk would otherwise cause lost samples.
            self._sync = BackgroundJob("recording", lambda: os.fsync(self._file.fileno()))
        return True

    def finish(self) -> None:
        """Write the last chunk and the summary. The file remains open."""
        self._writer.finish()
        self._file.flush()
        if self._sync is not None:
            self._sync.wait(SYNCED_WITHIN_S)


@contextmanager
def recording_to(path: Path, header: RecordingHeader, *, max_s: float = MAX_S) -> Iterator[RecordingWriter]:
    """Open a writer for a new recording that replaces any older file once the first sample is written.
    After a crash, the file is readable up to the last complete chunk. A recording with pictures can be read only by
    the file's owner. Raises InputError if the file cannot be written, or another process is writing it.
    """
    part, file = path.with_name(f".{path.name}.part"), None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            with path.open("rb") as present:
                fcntl.flock(present, fcntl.LOCK_SH | fcntl.LOCK_NB)
        file = os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600), "wb")
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held until the file is closed, even if it is renamed
        file.truncate()
        os.fchmod(file.fileno(), 0o600 if header.colour or header.depth else 0o644)  # faces are private
    except OSError as error:
        if file is not None:
            file.close()
        is_taken = isinstance(error, BlockingIOError)
        problem = "is being recorded by another process" if is_taken else f"cannot be written: {error.strerror}"
        raise InputError(path, "", problem) from None
    try:
        with file:
            writer = RecordingWriter(file, header, max_s=max_s, on_first=lambda: put_in_place(part, path))
            try:
                yield writer
            finally:
                if writer.count:
                    writer.finish()
                    os.fsync(file.fileno())
                else:
                    part.unlink(missing_ok=True)
    except OSError as error:
        if error.filename is None and error.errno is not None:  # a failed write, such as on a full disk
            raise InputError(path, "", f"cannot be written: {error.strerror}") from None
        raise


class Recording:
    """A recording that is read one sample at a time, because its pictures could fill the memory.

    Attributes:
        path: File path.
        is_whole: True unless reading has found the file to be truncated or damaged.
        header: Properties of the whole recording.
        first: First sample.
    """

    def __init__(self, path: Path) -> None:
        """Read the header and the first sample. Raises InputError if the file has none or cannot be read."""
        self.path, self.is_whole = path, True
        self._written_by = ("", "")  # profile and library in the MCAP file's header
        self.header = self._read_header()
        first = next(self.samples(), None)
        if first is None:
            cut_off = "" if self.is_whole else " because the file ends within the first sample"
            raise InputError(path, "", f"contains no complete sample{cut_off}")
        self.first = first

    def _opened(self) -> IO[bytes]:
        return untrusted_input.open_regular(self.path, most_bytes=LIMITS.file_bytes)

    def _read_header(self) -> RecordingHeader:
        """Return the header from the metadata record, which repair tools move to the file's end. Raises InputError."""
        foreign = ""
        for topic, record in self._records():
            if topic and topic not in fmt.SCHEMAS:
                foreign = f"topic {untrusted_input.shown(topic)}"
                break
            if not topic and record.name == fmt.METADATA_NAME:
                try:
                    return RecordingHeader.from_metadata(record.metadata)
                except ValueError as error:
                    raise InputError(self.path, fmt.METADATA_NAME, str(error)) from None
        if not foreign and not self.is_whole:
            raise InputError(self.path, "", "is an MCAP recording that ends before its first sample")
        by = ", ".join(filter(None, (*self._written_by, foreign)))
        raise InputError(self.path, fmt.METADATA_NAME, f"is missing from this MCAP recording ({by}); {NEEDED}")

    def _records(self) -> Iterator[tuple[str, Any]]:
        """Yield messages with their topics, and metadata with an empty topic, up to the first damaged record."""
        from mcap.records import Channel, Header, Message, Metadata

        topics: dict[int, str] = {}
        with self._opened() as file:
            for record in self._to_the_break(file):
                if isinstance(record, Header):
                    self._written_by = (untrusted_input.shown(record.profile), untrusted_input.shown(record.library))
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    yield topics.get(record.channel_id, "?"), record
                elif isinstance(record, Metadata):
                    yield "", record

    def _to_the_break(self, file: IO[bytes]) -> Iterator[Any]:
        try:
            if (begin := file.read(len(MAGIC))) != MAGIC:
                problem = "is not an MCAP recording" if begin else "is empty"
                raise InputError(self.path, "", problem + KINDS.get(begin, ""))
            yield from _mcap_records(file, source=self.path, max_bytes=LIMITS.chunk_bytes)
        except (InputError, ImportError):
            raise
        except OSError as error:
            raise InputError(self.path, "", f"cannot be read: {error.strerror}") from None
        except Exception as error:  # errors raised by mcap, lz4 and zstandard for a damaged file
            if self.is_whole:
                problem = str(error) or type(error).__name__
                log.warning("%s: the file is truncated or damaged; reading the intact part: %s", self.path, problem)
            self.is_whole = False

    def samples(self) -> Iterator[SensorFrame]:
        """Yield all samples whose eye points have been read, in file order. Raises InputError."""
        parts: dict[str, Any] = {}
        intrinsics: Intrinsics | None = None
        for topic, message in self._records():
            try:
                if topic == fmt.COLOUR_TOPIC:
                    parts["colour"] = fmt.colour_from_message(message.data, max_pixels=LIMITS.pixels)
                elif topic == fmt.DEPTH_TOPIC:
                    parts["depth_mm"] = fmt.depth_from_message(message.data)
                elif topic == fmt.CALIBRATION_TOPIC:
                    intrinsics = fmt.intrinsics_from_message(message.data)
                elif topic == fmt.EYES_TOPIC:
                    yield replace(fmt.frame_from_eyes_message(message.data), intrinsics=intrinsics, **parts)
                    parts = {}
            except ValueError as error:
                raise InputError(self.path, topic, f"malformed message: {error}") from None


def _mcap_records(file: IO[bytes], *, source: Path, max_bytes: int) -> Iterator[Any]:
    """Yield all records up to the footer, including those inside chunks, of at most `max_bytes` each. Raises InputError
    beyond `max_bytes`, and for damage or a truncated file ValueError or one of mcap's or a decompressor's exceptions.
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    indexed = _indexed_chunks(file, max_bytes=max_bytes)
    file.seek(0)
    for record in StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=max_bytes).records:
        if isinstance(record, Chunk):
            data = _unpacked(record, source=source, max_bytes=max_bytes)
            yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)
        else:
            yield record
        # mcap skips unknown records
        if (end := file.tell()) in indexed and os.pread(file.fileno(), len(CHUNK), end) != CHUNK:
            raise ValueError(f"the chunk at byte {end} has no chunk marker")


def _indexed_chunks(file: IO[bytes], *, max_bytes: int) -> set[int]:
    """Return the byte offsets of the chunks listed in the file's summary, none if it is not readable."""
    from mcap.reader import FOOTER_SIZE
    from mcap.records import ChunkIndex
    from mcap.stream_reader import StreamReader

    def records(data: bytes) -> Iterator[Any]:
        yield from StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True, record_size_limit=max_bytes).records

    try:
        end = file.seek(-(FOOTER_SIZE + len(MAGIC)), os.SEEK_END)
        begin = file.seek(next(records(file.read())).summary_start)
        summary = records(file.read() if end - begin < max_bytes else b"")
        return {record.chunk_start_offset for record in summary if isinstance(record, ChunkIndex)}
    except Exception:  # truncated, damaged or not an MCAP file
        return set()


def _unpacked(chunk: Any, *, source: Path, max_bytes: int) -> bytes:
    """Return a chunk's decompressed records. Raises InputError beyond `max_bytes`, ValueError for a wrong size."""
    declared: int = chunk.uncompressed_size
    room = min(declared, max_bytes) + 1  # decompressors allocate up to their limit
    data = _expanded(chunk.compression, chunk.data, room=room)
    if len(data) > max_bytes:
        size = f"a chunk of {len(chunk.data)} bytes unpacks to {max(declared, len(data)) / MIB:.1f} MiB"
        raise InputError(source, "", f"{size}, but the maximum is {max_bytes / MIB:g} MiB")
    if len(data) != declared:
        raise ValueError(f"a chunk does not unpack to the {declared} bytes that it declares")
    return data


def _expanded(compression: str, data: bytes, *, room: int) -> bytes:
    """Decompress `lz4` or `zstd` data to at most `room` bytes; return others unchanged."""
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=room))
    if compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES).stream_reader(data) as stream:
            return bytes(stream.read(room))
    return data
