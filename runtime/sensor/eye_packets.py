"""The eye-packet protocol: what an eye tracker that computes on the device streams over a bulk endpoint.

A packet is 56 bytes, little-endian; fields in order:

    magic 4s `PSEY` | version u8 = 1 | flags u8 | length u16 = 56 | sequence u32 | device time u64, microseconds
    left eye 3 x f32 mm | right eye 3 x f32 mm | confidence left, right 2 x f32, 0 to 1 | CRC-32 u32

Flag bit 0: a face is seen (else the points mean nothing); bit 1, 2: the left, right eye was hidden and is
completed. Points are in the sensor's frame (+x right, +y down, +z away), left is the viewer's. The CRC is
that of zlib over everything before it. Packets may be split over transfers, and several may share one.
"""

from __future__ import annotations

import struct
import zlib
from typing import Literal, NamedTuple

import numpy as np

from runtime.records import EyePoints

MAGIC = b"PSEY"
VERSION = 1
LAYOUT = struct.Struct("<4sBBHIQ8f")
CRC = struct.Struct("<I")
PACKET_BYTES = LAYOUT.size + CRC.size
HAS_FACE, COMPLETED_LEFT, COMPLETED_RIGHT = 1, 2, 4
M_PER_MM = 1e-3


class EyePacket(NamedTuple):
    """One packet. `points` is None without a face; its frame is `sensor`."""

    sequence: int  # modulo 2^32
    device_time_us: int
    points: EyePoints | None


def _decode(data: bytes) -> EyePacket | None:
    """PACKET_BYTES that begin with the magic as a packet; None where it is not one."""
    magic, version, flags, length, sequence, time_us, *numbers = LAYOUT.unpack_from(data)
    (crc,) = CRC.unpack_from(data, LAYOUT.size)
    if magic != MAGIC or version != VERSION or length != PACKET_BYTES or crc != zlib.crc32(data[: LAYOUT.size]):
        return None
    points = None
    if flags & HAS_FACE:
        completed: Literal["", "left", "right"] = ""
        if flags & (COMPLETED_LEFT | COMPLETED_RIGHT):
            completed = "left" if flags & COMPLETED_LEFT else "right"
        values = np.array(numbers)
        points = EyePoints(values[:6].reshape(2, 3) * M_PER_MM, values[6:], completed)
    return EyePacket(sequence, time_us, points)


class PacketReader:
    """Finds packets in a stream of bytes that may be cut anywhere, and may hold garbage.

    After garbage it goes on at the next magic whose packet's CRC is right. It never keeps more than one
    incomplete packet, so what a broken device sends can't pile up.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.garbage_bytes = 0  # skipped

    def feed(self, data: bytes) -> list[EyePacket]:
        """All packets that are complete with these bytes."""
        buffer, start = self._buffer + data, 0
        packets: list[EyePacket] = []
        while True:
            found = buffer.find(MAGIC, start)
            if found < 0:
                # The end may hold the beginning of a magic.
                keep = next((n for n in (3, 2, 1) if n <= len(buffer) - start and buffer.endswith(MAGIC[:n])), 0)
                self.garbage_bytes += len(buffer) - keep - start
                self._buffer = buffer[len(buffer) - keep :]
                return packets
            self.garbage_bytes += found - start
            if len(buffer) - found < PACKET_BYTES:
                self._buffer = buffer[found:]
                return packets
            packet = _decode(buffer[found : found + PACKET_BYTES])
            if packet is None:
                self.garbage_bytes += 1
                start = found + 1
                continue
            packets.append(packet)
            start = found + PACKET_BYTES
