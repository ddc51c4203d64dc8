"""The records of an MCAP file, one after the other, within a limit: what a chunk unpacks to is not taken on trust."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from runtime.errors import InputError
from runtime.support.untrusted_input import MIB


class Damaged(ValueError):
    """From here on the file is not what was written."""


def mcap_records(file: IO[bytes], *, source: Path, max_bytes: int) -> Iterator[Any]:
    """Records in order, those within chunks too, until the footer.

    max_bytes: of one record, and of one chunk unpacked. Raises InputError over the limit, and mcap's own, ValueError,
    or what an unpacker raises for a damaged file.
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    guarded: Any = _Guarded(file, source=source, max_bytes=max_bytes)
    for record in StreamReader(guarded, emit_chunks=True, validate_crcs=True, record_size_limit=None).records:
        if isinstance(record, Chunk):
            yield from _records_of(_unpacked(record, source=source, max_bytes=max_bytes), source=source)
        else:
            yield record


def _over(count: int, max_bytes: int, what: str) -> str:
    return f"{what} {count / MIB:.1f} MiB; at most {max_bytes / MIB:g}"


class _Guarded:
    """A file whose `read` takes no length that isn't there, or is over the limit: mcap hands on what the file says."""

    def __init__(self, file: IO[bytes], *, source: Path, max_bytes: int) -> None:
        self._file, self._source, self._max_bytes = file, source, max_bytes
        file.seek(0, io.SEEK_END)
        self.remaining = file.tell()
        file.seek(0)

    def read(self, count: int) -> bytes:
        if not 0 <= count <= self.remaining:
            raise Damaged("a field is longer than the file")  # a break, or a flipped bit
        if count > self._max_bytes:
            raise InputError(self._source, "", _over(count, self._max_bytes, "a record has"))
        data = self._file.read(count)
        self.remaining -= len(data)
        return data


def _unpacked(chunk: Any, *, source: Path, max_bytes: int) -> bytes:
    """A chunk's records as bytes. Raises InputError over the limit, else what the unpacker raises."""
    says: int = chunk.uncompressed_size
    room = min(says, max_bytes) + 1  # unpackers take the memory that they are allowed
    if chunk.compression == "":
        data: bytes = chunk.data
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=room)
    elif chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor(max_window_size=max(1024, max_bytes)).stream_reader(chunk.data) as stream:
            data = stream.read(room)
    else:
        raise Damaged(f"unknown compression {chunk.compression[:20]!r}")
    if len(data) > max_bytes:
        size = max(says, len(data))
        raise InputError(source, "", _over(size, max_bytes, f"a chunk of {len(chunk.data)} bytes unpacks to"))
    if chunk.compression and len(data) != says:
        raise Damaged(f"a chunk does not unpack to the {says} bytes that it says")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Damaged("a chunk's checksum is wrong")
    return data


def _records_of(data: bytes, *, source: Path) -> Iterator[Any]:
    """Channels and messages of a chunk, made one at a time: millions of empty ones would fill the memory."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message

    guarded: Any = _Guarded(io.BytesIO(data), source=source, max_bytes=len(data))
    stream = ReadDataStream(guarded)
    while stream.count < len(data):
        opcode, length, start = stream.read1(), stream.read8(), stream.count
        if opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        stream.read(length - (stream.count - start))
