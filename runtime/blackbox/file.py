"""A black box as an MCAP file that is a recording too: `run --replay` reads its raw samples, other tools the rest."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from runtime.blackbox.messages import Message
from runtime.blackbox.schemas import schema_of
from runtime.errors import InputError
from runtime.sensor import recording_format as fmt
from runtime.sensor.recording_format import RecordingHeader
from runtime.support.version import version

CHUNK_BYTES = 1 << 18  # a crash loses at most one: some two seconds
METADATA_NAME = "phasestack.blackbox"


class BlackBoxFile:
    """Written under a hidden name until `finish`, or until its first chunk where it may be cut off."""

    def __init__(self, path: Path, header: RecordingHeader, *, why: str, settings: str = "") -> None:
        """why: it is written; settings: JSON of those in force. Raises InputError where it can't be written."""
        from mcap.writer import CompressionType, Writer

        self.path, self.bytes_written = path, 0
        self._part = path.with_name(f".{path.name}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = self._part.open("wb")
        except OSError as error:
            raise InputError(path, "", f"cannot be written ({error.strerror})") from None
        self._writer: Any = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._channels: dict[str, int] = {}
        self._writer.start(profile="phasestack", library=f"phasestack {version()}")
        self._writer.add_metadata(fmt.METADATA_NAME, header.metadata())
        self._writer.add_metadata(METADATA_NAME, {"why": why, "version": version()})
        if settings:
            self._writer.add_attachment(0, 0, "settings.json", "application/json", settings.encode())

    def write(self, message: Message) -> None:
        """Append one message. Raises OSError where the disk is full."""
        wall_ns = max(0, message.wall_ns)
        self._writer.add_message(self._channel(message.topic), wall_ns, message.data, wall_ns, message.sequence)

    def write_all(self, messages: Iterable[Message]) -> None:
        """Append messages."""
        for message in messages:
            self.write(message)

    def flush(self) -> None:
        """What is written so far is there for others, under the file's name. Raises OSError."""
        self._file.flush()
        self.bytes_written = self._file.tell()
        if self._part.exists():
            self._part.replace(self.path)

    def finish(self) -> None:
        """Write the summary and close; the file has its name. Raises OSError."""
        try:
            self._writer.finish()
            self.flush()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """It can't be written any more: close it as it is. What has its name stays, what is hidden goes."""
        with suppress(OSError):  # what it still held back finds no room either
            self._file.close()
        self._part.unlink(missing_ok=True)

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            schema = schema_of(topic)
            number = self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        return self._channels[topic]
