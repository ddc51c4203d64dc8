"""The mouse pointer of an X server, read through libxcb.

libX11 is not used because it ends the process if the X server ends.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_char_p, c_int, c_int16, c_uint, c_uint8, c_uint16, c_uint32, c_void_p
from typing import Any

BUTTON = 1 << 8  # bit of the first mouse button


class _Screens(Structure):
    _fields_ = (("data", POINTER(c_uint32)), ("rem", c_int), ("index", c_int))  # a screen begins with its root window


class _Cookie(Structure):
    _fields_ = (("sequence", c_uint),)


class Pointed(Structure):
    """Place of the pointer, in pixels from the screen's top left corner."""

    _fields_ = (
        ("response", c_uint8), ("same_screen", c_uint8), ("sequence", c_uint16), ("length", c_uint32),
        ("root", c_uint32),
        ("child", c_uint32),  # number of the top-level window under the pointer, or 0
        ("x", c_int16), ("y", c_int16), ("window_x", c_int16), ("window_y", c_int16),
        ("buttons", c_uint16),  # pressed buttons and keys, such as `BUTTON`
    )  # fmt: skip


class XPointer:
    """Connection to an X server that reads its pointer."""

    def __init__(self, display: str) -> None:
        """Connect. Raises OSError if libxcb is missing or the server cannot be reached."""
        self._xcb, self._free = ctypes.CDLL("libxcb.so.1"), ctypes.CDLL(None).free
        self._free.argtypes = [c_void_p]
        for name, result, *given in (
            ("xcb_connect", c_void_p, c_char_p, c_void_p),
            ("xcb_connection_has_error", c_int, c_void_p),
            ("xcb_disconnect", None, c_void_p),
            ("xcb_get_setup", c_void_p, c_void_p),
            ("xcb_setup_roots_iterator", _Screens, c_void_p),
            ("xcb_query_pointer", _Cookie, c_void_p, c_uint32),
            ("xcb_query_pointer_reply", POINTER(Pointed), c_void_p, _Cookie, c_void_p),
        ):
            function: Any = getattr(self._xcb, name)
            function.restype, function.argtypes = result, given
        self._connection: Any = self._xcb.xcb_connect(display.encode(), None)
        if self._xcb.xcb_connection_has_error(self._connection):
            self.close()
            raise OSError(f"the X server {display} cannot be used")
        setup = self._xcb.xcb_get_setup(self._connection)
        self._root: int = self._xcb.xcb_setup_roots_iterator(setup).data[0]

    def now(self) -> Pointed | None:
        """Return the pointer's place, or None if it is on another screen or the connection is lost."""
        cookie = self._xcb.xcb_query_pointer(self._connection, self._root)
        reply = self._xcb.xcb_query_pointer_reply(self._connection, cookie, None)
        if not reply:
            return None
        found = Pointed.from_buffer_copy(reply.contents)
        self._free(reply)
        return found if found.same_screen else None

    def close(self) -> None:
        """Close the connection. Has no effect if it is closed."""
        if self._connection is not None:
            self._xcb.xcb_disconnect(self._connection)
            self._connection = None
