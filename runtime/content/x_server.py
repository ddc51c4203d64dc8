"""Ask an X server for its pointer and programs, and programs whether they respond.

libxcb is called through ctypes, because libX11 ends the process if the X server ends.
"""

from __future__ import annotations

import ctypes
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from ctypes import POINTER, Structure, c_char_p, c_int, c_uint, c_uint32, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import Any

AUTOMATIC = 0  # a redirected window is still shown
ASKS_EVERY_S = 1.0  # how often a program is asked whether it responds
RESPONDS_WITHIN_S = 5.0
EVENT_MASK = 1 << 11  # an attribute of windows
RESPONSES = struct.pack("=I", 1 << 19 | 1 << 17)  # SubstructureNotify and, for Qt, StructureNotify of the root window
CLIENT_MESSAGE = 33  # kind of event
RESOURCES, PROCESS = b"X-Resource", 2  # extension that knows a window's process, if it is on the server's computer


@dataclass(frozen=True, slots=True)
class Pointer:
    """The mouse pointer, in pixels from the screen's top left corner."""

    x: int
    y: int
    child: int  # number of the top-level window under the pointer, or 0
    buttons: int  # mask of pressed buttons and keys


class _Screens(Structure):
    _fields_ = (("data", POINTER(c_uint32)), ("rem", c_int), ("index", c_int))  # a screen begins with its root window


class _Cookie(Structure):
    _fields_ = (("sequence", c_uint),)


class XConnection:
    """Connection to an X server that reads its pointer, keeps covered windows and finds hung programs."""

    def __init__(self, display: str) -> None:
        """Connect. Raises OSError if libxcb is missing or the server cannot be reached."""
        self._xcb, self._free, self._resources = ctypes.CDLL("libxcb.so.1"), ctypes.CDLL(None).free, None
        for name in ("xcb_connect", "xcb_get_setup", "xcb_poll_for_event"):
            getattr(self._xcb, name).restype = c_void_p
        self._xcb.xcb_setup_roots_iterator.restype = _Screens
        self._connection: Any = c_void_p(self._xcb.xcb_connect(c_char_p(display.encode()), None))
        if self._xcb.xcb_connection_has_error(self._connection):
            self.close()
            raise OSError(f"the X server {display} cannot be used")
        setup = c_void_p(self._xcb.xcb_get_setup(self._connection))
        self._root: int = self._xcb.xcb_setup_roots_iterator(setup).data[0]
        if self._ask("query_extension", len(RESOURCES), c_char_p(RESOURCES))[8:9] == b"\1":
            with suppress(OSError):
                self._resources = ctypes.CDLL("libxcb-res.so.0")
        self._protocols, self._ping = self._atom(b"WM_PROTOCOLS"), self._atom(b"_NET_WM_PING")
        self._asked = 0  # number of the window that has yet to respond, or 0
        self._responded = 0  # number of the window that responded last
        self._asked_s = self._looked_s = 0.0
        self._is_stopped = False

    def _ask(self, name: str, *given: Any, of: Any = None) -> bytes:
        """Send a request of libxcb or another library and return the reply, or nothing if there is none."""
        library = of or self._xcb
        request, reply = getattr(library, f"xcb_{name}"), getattr(library, f"xcb_{name}_reply")
        request.restype, reply.restype = _Cookie, c_void_p
        found = reply(self._connection, request(self._connection, *given), None)
        if not found:
            return b""
        length = struct.unpack_from("=I", ctypes.string_at(found, 8), 4)[0]
        data = ctypes.string_at(found, 32 + 4 * length)
        self._free(c_void_p(found))
        return data

    def _atom(self, name: bytes) -> int:
        return int.from_bytes(self._ask("intern_atom", 0, len(name), c_char_p(name))[8:12], "little")

    def now(self) -> Pointer | None:
        """Return the pointer, or None if it is on another screen or the connection is lost."""
        is_here, child, x, y, buttons = struct.unpack_from(
            "=xB10xI2h4xH", self._ask("query_pointer", self._root) or bytes(32)
        )
        return Pointer(x, y, child, buttons) if is_here else None

    def keep_covered(self, window: int) -> None:
        """Have the server keep a window's picture where others cover it, until `close`. Has no effect without
        libxcb-composite.
        """
        with suppress(OSError):
            ctypes.CDLL("libxcb-composite.so.0").xcb_composite_redirect_window(self._connection, window, AUTOMATIC)
            self.now()  # waits until the server has done so

    def hangs(self, window: int) -> bool:
        """Return whether a window's program is stopped, or no longer responds to _NET_WM_PING.
        Without a window, the screen's topmost one is meant. Call this for each picture.
        """
        while event := self._xcb.xcb_poll_for_event(self._connection):
            kind, protocol, about = struct.unpack("=B11xI4xI", ctypes.string_at(event, 24))
            self._free(c_void_p(event))
            if kind & 0x7F == CLIENT_MESSAGE and (protocol, about) == (self._ping, self._asked):
                self._asked, self._responded = 0, about
        now_s = time.monotonic()
        if now_s > self._looked_s + ASKS_EVERY_S:
            self._looked_s = now_s
            self._xcb.xcb_change_window_attributes(self._connection, self._root, EVENT_MASK, RESPONSES)
            windows = list(self._around(window))
            self._is_stopped = bool(windows) and self._stopped(windows[0])
            asked = next(filter(self._supports_ping, windows), 0)
            if asked != self._asked:
                self._asked, self._asked_s = asked, now_s
            if asked:
                event = struct.pack(
                    "=BBHII5I", CLIENT_MESSAGE, 32, 0, asked, self._protocols, self._ping, 0, asked, 0, 0
                )
                self._xcb.xcb_send_event(self._connection, 0, asked, 0, event)
                self._xcb.xcb_flush(self._connection)
        is_late = now_s > self._asked_s + RESPONDS_WITHIN_S
        return self._is_stopped or (is_late and self._asked != 0 and self._asked == self._responded)

    def _around(self, window: int) -> Iterator[int]:
        """Yield a window and those that contain it, or with 0 all windows of the screen, the topmost one first."""
        if not window:
            data = self._ask("query_tree", self._root)[32:]
            yield from reversed(struct.unpack(f"={len(data) // 4}I", data))
        while window not in (0, self._root):
            yield window
            window = int.from_bytes(self._ask("query_tree", window)[12:16], "little")

    def _supports_ping(self, window: int) -> bool:
        data = self._ask("get_property", 0, window, self._protocols, 0, 0, 64)[32:]
        return self._ping in struct.unpack(f"={len(data) // 4}I", data)

    def _stopped(self, window: int) -> bool:
        """Return whether a window's program is stopped, as far as the server knows its process."""
        if self._resources is None:
            return False
        asked = struct.pack("=II", window, PROCESS)
        reply = self._ask("res_query_client_ids", 1, asked, of=self._resources)
        with suppress(OSError, struct.error):
            status = Path(f"/proc/{struct.unpack_from('=I', reply, 44)[0]}/stat").read_text(errors="replace")
            return status.rpartition(")")[2].split()[0] in "Tt"
        return False

    def close(self) -> None:
        """Close the connection. Has no effect if it is closed."""
        if self._connection is not None:
            self._xcb.xcb_disconnect(self._connection)
            self._connection = None
