"""The eye-packet protocol finds its packets whatever stands between them, and counts what is missing."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.records import EyePoints
from runtime.sensor.eye_packets import MAGIC, PACKET_BYTES, EyePacket, PacketReader
from tests.sensor.fake_usb import encode, packet

coordinates = st.floats(-5, 5, width=32)


@given(
    sequence=st.integers(0, 2**32 - 1),
    time_us=st.integers(0, 2**64 - 1),
    numbers=st.lists(coordinates, min_size=6, max_size=6),
    completed=st.sampled_from(["", "left", "right"]),
    face=st.booleans(),
)
def test_a_packet_comes_back_as_it_was_sent(
    sequence: Any, time_us: Any, numbers: Any, completed: Any, face: Any
) -> None:
    points = EyePoints(np.array(numbers).reshape(2, 3), np.array([0.25, 1.0]), completed) if face else None
    (back,) = PacketReader().feed(encode(EyePacket(sequence, time_us, points)))
    assert (back.sequence, back.device_time_us, back.points is None) == (sequence, time_us, not face)
    if points is not None:
        np.testing.assert_allclose(back.points.eyes_m, points.eyes_m, rtol=1e-6, atol=1e-30)
        assert back.points.completed == completed


def test_the_layout_is_the_documented_one() -> None:
    data = encode(packet(7, time_us=1234))
    assert len(data) == PACKET_BYTES == 56
    assert struct.unpack_from("<4sBBHIQ", data) == (b"PSEY", 1, 1, 56, 7, 1234)
    assert struct.unpack_from("<f", data, 20)[0] == pytest.approx(31.0)  # the left eye's x, in millimetres
    assert struct.unpack("<I", data[52:])[0] == zlib.crc32(data[:52])


@given(
    junk=st.lists(st.one_of(st.binary(max_size=80), st.just(MAGIC), st.just(MAGIC + b"\x01")), max_size=6),
    cuts=st.lists(st.integers(1, 60), max_size=40),
)
def test_whole_packets_are_found_between_garbage_however_the_stream_is_cut(junk: Any, cuts: Any) -> None:
    stream, sent = b"", 0
    for piece in junk:
        sent += 1
        stream += piece + encode(packet(sent))
    reader, found = PacketReader(), []
    for cut in cuts:
        found += reader.feed(stream[:cut])
        stream = stream[cut:]
    found += reader.feed(stream)
    assert [p.sequence for p in found] == list(range(1, sent + 1))


def test_a_packet_with_one_wrong_bit_is_refused_and_the_next_is_taken() -> None:
    for bit in range(0, PACKET_BYTES * 8, 7):
        data = bytearray(encode(packet(1)))
        data[bit // 8] ^= 1 << bit % 8
        assert [p.sequence for p in PacketReader().feed(bytes(data) + encode(packet(2)))] == [2]
