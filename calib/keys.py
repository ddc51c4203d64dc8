"""Keyboard input: lines and single keys in the terminal, single keys on a panel's window."""

from __future__ import annotations

import os
import select
import sys
from enum import Enum, auto
from typing import Any


class Key(Enum):
    """Keys and their meaning."""

    ACCEPT = auto()
    NEXT = auto()
    PREVIOUS = auto()
    LEFT = auto()
    RIGHT = auto()
    UP = auto()
    DOWN = auto()
    QUIT = auto()


# What a key means: GLFW's names of it, and its bytes in a terminal.
_MEANINGS: dict[Key, tuple[str, tuple[bytes, ...]]] = {
    Key.RIGHT: ("RIGHT", (b"\x1b[C",)),
    Key.LEFT: ("LEFT", (b"\x1b[D",)),
    Key.UP: ("UP", (b"\x1b[A",)),
    Key.DOWN: ("DOWN", (b"\x1b[B",)),
    Key.ACCEPT: ("ENTER KP_ENTER SPACE", (b"\n", b"\r", b" ")),
    Key.NEXT: ("N", (b"n",)),
    Key.PREVIOUS: ("P", (b"p",)),
    Key.QUIT: ("Q ESCAPE", (b"q", b"\x04")),
}
_OF_BYTES = {data: key for key, (_, pieces) in _MEANINGS.items() for data in pieces}


def parse(data: bytes) -> tuple[list[Key], bytes]:
    """Keys in bytes from a terminal, and the rest: an escape sequence that is not complete yet."""
    keys: list[Key] = []
    while data:
        if data[:1] == b"\x1b" and len(data) < 3 and b"\x1b[".startswith(data[:2]):
            return keys, data
        length = 3 if data[:2] == b"\x1b[" else 1
        if data[:length] in _OF_BYTES:
            keys.append(_OF_BYTES[data[:length]])
        data = data[length:]
    return keys, b""


class TerminalKeys:
    """Standard input; while keys are asked for a terminal is in character mode. The end of input quits."""

    def __init__(self, descriptor: int | None = None, *, quit_at_end: bool = True) -> None:
        """quit_at_end False: without an input (a service, `< /dev/null`) there are no keys, and that is all."""
        self._quit_at_end = quit_at_end
        self._descriptor = _standard_input() if descriptor is None else descriptor
        self._rest = b""
        self._mode: Any = None  # of the terminal, to go back to

    def poll(self) -> Key | None:
        """The next key, or None. Never waits."""
        if self._mode is None and self._descriptor >= 0 and os.isatty(self._descriptor):
            import termios
            import tty

            self._mode = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
        while self._descriptor >= 0 and select.select([self._descriptor], [], [], 0)[0]:
            data = os.read(self._descriptor, 1)
            if not data and self._quit_at_end:
                return Key.QUIT
            if not data:
                self._descriptor = -1
            keys, self._rest = parse(self._rest + data)
            if keys:
                return keys[0]
        return None

    def line(self) -> str:
        """The next line, waited for; `q` at the end of input."""
        self.close()
        data = b""
        while self._descriptor >= 0 and (read := os.read(self._descriptor, 1)) != b"\n":
            if not read:
                return "q"
            data += read
        return data.decode(errors="replace").strip() if self._descriptor >= 0 else "q"

    def close(self) -> None:
        """Give the terminal back. May be called twice."""
        if self._mode is not None:
            import termios

            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._mode)
            self._mode = None


def _standard_input() -> int:
    """Its descriptor; -1 where there is none, as in a service."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return -1


class WindowKeys:
    """Keys pressed while a panel's window has the keyboard, as they come with the windows' own events.

    The windows' events are taken in when a frame is presented; windows that were rebuilt are found again.
    """

    def __init__(self, sink: Any) -> None:
        """sink: the panels; those without windows have no keys."""
        self._sink = sink
        self._watched: list[Any] = []
        self._pending: list[Key] = []

    def poll(self) -> Key | None:
        """The next key, or None. Never waits. Call it after a frame was presented, on the windows' thread."""
        # The panels keep their windows to themselves; nothing but their keyboard is wanted of them.
        handles = [window.handle for window, _ in getattr(self._sink, "_surfaces", ())]
        if handles != self._watched:
            self._watch(handles)
        return self._pending.pop(0) if self._pending else None

    def _watch(self, handles: list[Any]) -> None:
        from runtime.panels.display import glfw

        meanings = {
            getattr(glfw, f"KEY_{name}"): key for key, (names, _) in _MEANINGS.items() for name in names.split()
        }

        def pressed(_window: Any, key: int, _code: int, action: int, _modifiers: int) -> None:
            if action != glfw.RELEASE and key in meanings:
                self._pending.append(meanings[key])

        for handle in handles:
            glfw.set_key_callback(handle, pressed)
        self._watched = handles
