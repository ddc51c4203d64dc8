"""Damages good files: flips, cuts and splices bytes, and inserts bad numbers and texts."""

from __future__ import annotations

import re

from hypothesis import strategies as st

NUMBERS = [
    b"0", b"-1", b"1", b"1e300", b"1e999", b"-1e-320", b"NaN", b"Infinity", b"-Infinity", b"null", b"true", b"\"\"",
    b"4294967295", b"2147483648", b"9223372036854775808", b"18446744073709551616", b"9" * 400, b"9" * 5000,
    b"[]", b"{}", "²".encode(), b"0x10", b"1_000", b"-0.0", b"1e-300", b"65536", b"1000000",
]  # fmt: skip
TEXTS = [
    b"\0", b"\n", b"\xff\xfe", b"a\0b", b"x" * 5000, b"../../../../etc/passwd", b"/dev/zero", b"http://localhost/",
    b"[" * 3000, b'{"a":' * 3000, b"\"", b"\\", b"%00", "é²\u202e".encode(), b"\x1b[2J", b"end_header", b"data:,",
]  # fmt: skip
WORDS = [
    b"\x00" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x01\x00\x00\x00", b"\xff" * 8,
    b"\x00" * 8,
]  # fmt: skip
KINDS = ["flip", "byte", "word", "cut", "drop", "repeat", "number", "text", "splice", "insert"]
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
LONGEST = 1 << 20


@st.composite
def mutated(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """One of the seeds after some edits."""
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(0, 6))):
        data = edited(draw, data, seeds)[:LONGEST]
    return data


def edited(draw: st.DrawFn, data: bytes, seeds: list[bytes]) -> bytes:
    """The data after one edit."""
    place = draw(st.integers(0, max(len(data) - 1, 0)))
    kind = draw(st.sampled_from(KINDS))
    head, tail = data[:place], data[place:]
    if kind == "flip" and data:
        return head + bytes([data[place] ^ (1 << draw(st.integers(0, 7)))]) + tail[1:]
    if kind == "byte":
        return head + draw(st.binary(min_size=1, max_size=1)) + tail[1:]
    if kind == "word":
        word = draw(st.sampled_from(WORDS))
        return head + word + tail[len(word) :]
    if kind == "cut":
        return head
    if kind == "drop":
        return head + tail[draw(st.integers(1, 200)) :]
    if kind == "repeat":
        return head + tail[: draw(st.integers(1, 300))] * draw(st.integers(2, 50)) + tail
    if kind == "number":
        found = list(NUMBER.finditer(data))
        if found:
            chosen = found[draw(st.integers(0, len(found) - 1))]
            return data[: chosen.start()] + draw(st.sampled_from(NUMBERS)) + data[chosen.end() :]
    if kind == "text":
        return head + draw(st.sampled_from(TEXTS)) + tail
    if kind == "splice":
        other = draw(st.sampled_from(seeds))
        return head + other[draw(st.integers(0, max(len(other) - 1, 0))) :]
    return head + draw(st.binary(max_size=16)) + tail
