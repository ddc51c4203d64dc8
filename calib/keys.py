"""Read lines and single keys from the terminal, and single keys from the panels' windows."""

from __future__ import annotations

import os
import select
import sys
from enum import Enum, auto
from typing import Any

from runtime.panels.base import PanelSink


class Key(Enum):
    """Keys understood during setup, named after their meaning."""

    ACCEPT = auto()
    NEXT = auto()
    PREVIOUS = auto()
    LEFT = auto()
    RIGHT = auto()
    UP = auto()
    DOWN = auto()
    QUIT = auto()


# Each key's names in GLFW, and the byte sequences that a terminal sends for it.
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
    """Decode bytes from a terminal into keys, and the bytes of an incomplete escape sequence."""
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
    """Reader for standard input: the first `poll` sets character mode, and `close` restores it."""

    def __init__(self, descriptor: int | None = None, *, quit_at_end: bool = True) -> None:
        """Choose a file descriptor, by default standard input, whose end is reported as `QUIT` or never."""
        self._quit_at_end = quit_at_end
        self._descriptor = _standard_input() if descriptor is None else descriptor
        self._rest = b""
        self._mode: Any = None  # the terminal's previous mode

    def poll(self) -> Key | None:
        """Return the next key without waiting, or None if no key was pressed."""
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
        """Wait for the next line, stripped, or `q` at end of input."""
        self.close()
        data = b""
        while self._descriptor >= 0 and (read := os.read(self._descriptor, 1)) != b"\n":
            if not read:
                return "q"
            data += read
        return data.decode(errors="replace").strip() if self._descriptor >= 0 else "q"

    def close(self) -> None:
        """Restore the terminal's previous mode. Further calls have no effect."""
        if self._mode is not None:
            import termios

            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._mode)
            self._mode = None


def _standard_input() -> int:
    """Return the file descriptor of standard input, or -1 if the process has no standard input."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return -1


class WindowKeys:
    """Reader for keys pressed in the panels' windows, which GLFW delivers when a frame is presented."""

    def __init__(self, sink: PanelSink) -> None:
        self._sink = sink
        self._watched: list[Any] = []
        self._pending: list[Key] = []

    def poll(self) -> Key | None:
        """Return the next key or None, after a frame was presented in the thread that created the windows."""
        handles = self._sink.window_handles
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
