"""Keys from a terminal's bytes."""

from __future__ import annotations

import os

import pytest

from calib.keys import Key, TerminalKeys, parse


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"\n", [Key.ACCEPT]),
        (b"np q", [Key.NEXT, Key.PREVIOUS, Key.ACCEPT, Key.QUIT]),
        (b"\x1b[C\x1b[D\x1b[A\x1b[B", [Key.RIGHT, Key.LEFT, Key.UP, Key.DOWN]),
        (b"xyz", []),
        (b"\x1b[Zn", [Key.NEXT]),
    ],
)
def test_bytes_mean_keys(data: bytes, keys: list[Key]) -> None:
    assert parse(data) == (keys, b"")


def test_a_closed_input_quits_and_an_idle_one_says_nothing() -> None:
    reading, writing = os.pipe()
    keys = TerminalKeys(reading)
    assert keys.poll() is None
    os.write(writing, b"np344.2\n")
    assert [keys.poll(), keys.poll(), keys.line(), keys.poll()] == [Key.NEXT, Key.PREVIOUS, "344.2", None]
    os.close(writing)
    assert (keys.poll(), keys.line()) == (Key.QUIT, "q")
    keys.close()
    os.close(reading)
