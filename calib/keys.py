"""Keys that a person presses in the terminal: one at a time, without waiting."""

from __future__ import annotations

import os
import select
import sys
from enum import Enum, auto


class Key(Enum):
    """What a key means here."""

    ACCEPT = auto()
    NEXT = auto()
    PREVIOUS = auto()
    LEFT = auto()
    RIGHT = auto()
    UP = auto()
    DOWN = auto()
    FINER = auto()
    COARSER = auto()
    QUIT = auto()


_MEANINGS = {
    b"\x1b[C": Key.RIGHT,
    b"\x1b[D": Key.LEFT,
    b"\x1b[A": Key.UP,
    b"\x1b[B": Key.DOWN,
    b"\n": Key.ACCEPT,
    b"\r": Key.ACCEPT,
    b" ": Key.ACCEPT,
    b"n": Key.NEXT,
    b"p": Key.PREVIOUS,
    b"f": Key.FINER,
    b"c": Key.COARSER,
    b"q": Key.QUIT,
    b"\x04": Key.QUIT,
}


def parse(data: bytes) -> tuple[list[Key], bytes]:
    """Keys in bytes from a terminal, and the rest: an escape sequence that is not complete yet."""
    keys = []
    while data:
        if data[:1] == b"\x1b" and len(data) < 3 and b"\x1b[".startswith(data[:2]):
            return keys, data
        length = 3 if data[:2] == b"\x1b[" else 1
        meaning = _MEANINGS.get(data[:length])
        if meaning is not None:
            keys.append(meaning)
        data = data[length:]
    return keys, b""


class TerminalKeys:
    """Keys from standard input; a terminal is put into character mode until `close`. The end of input quits."""

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        self._pending: list[Key] = []
        self._rest = b""
        self._mode = None
        if os.isatty(self._descriptor):
            import termios
            import tty

            self._mode = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)

    def poll(self) -> Key | None:
        """The next key, or None. Never waits."""
        ready, _, _ = select.select([self._descriptor], [], [], 0)
        if ready:
            data = os.read(self._descriptor, 64)
            keys, self._rest = parse(self._rest + data)
            self._pending += keys if data else [Key.QUIT]
        return self._pending.pop(0) if self._pending else None

    def close(self) -> None:
        """Give the terminal back. May be called twice."""
        if self._mode is not None:
            import termios

            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._mode)
            self._mode = None
