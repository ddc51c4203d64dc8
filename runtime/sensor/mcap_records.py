"""The records of an MCAP file, one after the other, within a limit: what a chunk unpacks to is not taken on trust."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from runtime.errors import InputError
from runtime.support.untrusted_input import MIB


def mcap_records(file: IO[bytes], *, source: Path, max_bytes: int) -> Iterator[Any]:
    """Records in order, those within chunks too, until the footer.

    max_bytes: of one record, and of one chunk unpacked. Raises InputError for a chunk over the limit, and what mcap or
    an unpacker raises for a damaged file.
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    for record in StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=max_bytes).records:
        if isinstance(record, Chunk):
            data = _unpacked(record, source=source, max_bytes=max_bytes)
            yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)
        else:
            yield record


def _unpacked(chunk: Any, *, source: Path, max_bytes: int) -> bytes:
    """A chunk's records as bytes. Raises InputError over the limit, else what the unpacker raises."""
    says: int = chunk.uncompressed_size
    room = min(says, max_bytes) + 1  # unpackers take the memory that they are allowed
    data: bytes = chunk.data
    if chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=room)
    elif chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor(max_window_size=max(1024, max_bytes)).stream_reader(data) as stream:
            data = stream.read(room)
    if len(data) > max_bytes:
        told = f"a chunk of {len(chunk.data)} bytes unpacks to {max(says, len(data)) / MIB:.1f} MiB"
        raise InputError(source, "", f"{told}; at most {max_bytes / MIB:g}")
    if len(data) != says:
        raise ValueError(f"a chunk does not unpack to the {says} bytes that it says")
    return data
