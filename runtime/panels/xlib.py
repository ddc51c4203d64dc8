"""Query the state of outputs and handle X errors, using Xlib and RandR functions not offered by GLFW.

The functions are called through ctypes, in libraries that GLFW loads anyway. Without the error handlers, Xlib would end
the process after any error.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import select
import threading
from ctypes import POINTER, byref, c_char_p, c_int, c_long, c_ubyte, c_uint, c_ulong, c_void_p
from dataclasses import dataclass
from typing import NoReturn

from runtime.panels.monitors import Rectangle

log = logging.getLogger("phasestack.panels")

ErrorHandler = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)  # Xlib ignores what handlers return
IOErrorHandler = ctypes.CFUNCTYPE(None, c_void_p)
SERVER_DIED = 75  # EX_TEMPFAIL of sysexits.h


class Mode(ctypes.Structure):
    """XRRModeInfo."""

    _fields_ = (
        ("id", c_ulong),
        ("width", c_uint),
        ("height", c_uint),
        ("dot_clock", c_ulong),
        ("h_sync_start", c_uint),
        ("h_sync_end", c_uint),
        ("h_total", c_uint),
        ("h_skew", c_uint),
        ("v_sync_start", c_uint),
        ("v_sync_end", c_uint),
        ("v_total", c_uint),
        ("name", c_char_p),
        ("name_length", c_uint),
        ("flags", c_ulong),
    )


class _Resources(ctypes.Structure):
    _fields_ = (
        ("timestamp", c_ulong),
        ("config_timestamp", c_ulong),
        ("ncrtc", c_int),
        ("crtcs", POINTER(c_ulong)),
        ("noutput", c_int),
        ("outputs", POINTER(c_ulong)),
        ("nmode", c_int),
        ("modes", POINTER(Mode)),
    )


class _Output(ctypes.Structure):
    """First fields of XRROutputInfo."""

    _fields_ = (("timestamp", c_ulong), ("crtc", c_ulong))


class _Crtc(ctypes.Structure):
    """First fields of XRRCrtcInfo."""

    _fields_ = (
        ("timestamp", c_ulong),
        ("x", c_int),
        ("y", c_int),
        ("width", c_uint),
        ("height", c_uint),
        ("mode", c_ulong),
    )


@dataclass(frozen=True, slots=True)
class OutputState:
    """The mode and monitor of one of the graphics card's outputs."""

    place: Rectangle  # the region of the X screen shown by this output
    refresh_hz: float  # 0 if unknown
    edid: bytes  # empty if the monitor has no EDID


@functools.cache
def _libraries() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    x11, randr = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXrandr.so.2")
    x11.XDefaultRootWindow.restype, x11.XDefaultRootWindow.argtypes = c_ulong, [c_void_p]
    x11.XInternAtom.restype, x11.XInternAtom.argtypes = c_ulong, [c_void_p, c_char_p, c_int]
    x11.XFree.argtypes = [c_void_p]
    x11.XSetIOErrorHandler.restype, x11.XSetIOErrorHandler.argtypes = c_void_p, [IOErrorHandler]
    x11.XSetErrorHandler.restype, x11.XSetErrorHandler.argtypes = c_void_p, [ErrorHandler]
    randr.XRRGetScreenResourcesCurrent.restype = POINTER(_Resources)
    randr.XRRGetScreenResourcesCurrent.argtypes = [c_void_p, c_ulong]
    randr.XRRFreeScreenResources.argtypes = [POINTER(_Resources)]
    randr.XRRGetOutputInfo.restype = POINTER(_Output)
    randr.XRRGetOutputInfo.argtypes = [c_void_p, POINTER(_Resources), c_ulong]
    randr.XRRFreeOutputInfo.argtypes = [POINTER(_Output)]
    randr.XRRGetCrtcInfo.restype = POINTER(_Crtc)
    randr.XRRGetCrtcInfo.argtypes = [c_void_p, POINTER(_Resources), c_ulong]
    randr.XRRFreeCrtcInfo.argtypes = [POINTER(_Crtc)]
    randr.XRRGetOutputProperty.argtypes = [
        c_void_p, c_ulong, c_ulong, c_long, c_long, c_int, c_int, c_ulong,
        POINTER(c_ulong), POINTER(c_int), POINTER(c_ulong), POINTER(c_ulong), POINTER(POINTER(c_ubyte)),
    ]  # fmt: skip
    return x11, randr


_refused = 0  # number of refused requests


def refusals() -> int:
    """Return how many requests X has refused; if it grows, a window or monitor has disappeared."""
    return _refused


def _note_error(_display: int, _event: int) -> None:
    global _refused
    _refused += 1
    log.warning("the X server refused a request")


def _end(*_display: int) -> NoReturn:
    log.critical("the X server died; exiting with status %d for a restart", SERVER_DIED)
    for handler in (*logging.getLogger("phasestack").handlers, *logging.getLogger().handlers):
        handler.flush()
    os._exit(SERVER_DIED)


# Xlib holds pointers to these handlers until the process ends, so they must not be garbage-collected.
_ERROR_HANDLER = ErrorHandler(_note_error)
_IO_ERROR_HANDLER = IOErrorHandler(_end)


def take_over_errors() -> None:
    """Install handlers for X errors. If the X server refuses a request, for example because a monitor has
    been unplugged, this is only logged and counted. If the X server dies, the process logs a message and ends
    immediately, because Xlib, EGL and GLFW would hang or crash even when asked to release objects.
    """
    x11, _ = _libraries()
    x11.XSetErrorHandler(_ERROR_HANDLER)
    x11.XSetIOErrorHandler(_IO_ERROR_HANDLER)


class ServerWatch:
    """Ends the process if the X server dies while the main thread is stuck in a call. Without this, if
    the connection broke during a buffer swap, Mesa's software renderer would loop endlessly, and Xlib would not notice.
    """

    def __init__(self, display: int) -> None:
        """Watch a connection, given its open Xlib `Display`, on a new thread. Call `stop` before closing it."""
        x11, _ = _libraries()
        x11.XConnectionNumber.argtypes = [c_void_p]
        self._connection: int = x11.XConnectionNumber(display)
        self._stop_reading, self._stop_writing = os.pipe()
        self._thread = threading.Thread(target=self._watch, name="x-server", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop watching. Call this before deliberately closing the connection."""
        os.write(self._stop_writing, b".")
        self._thread.join()
        os.close(self._stop_reading)
        os.close(self._stop_writing)

    def _watch(self) -> None:
        poll = select.poll()
        poll.register(self._connection, 0)  # hang-ups and errors are reported, but not input
        poll.register(self._stop_reading, select.POLLIN)
        for file, _ in poll.poll():
            if file == self._connection:
                _end()


def output_state(display: int, output: int) -> OutputState | None:
    """Return an output's state, by four round trips, or None if it is off or disconnected."""
    x11, randr = _libraries()
    resources = randr.XRRGetScreenResourcesCurrent(display, x11.XDefaultRootWindow(display))
    if not resources:
        return None
    try:
        info = randr.XRRGetOutputInfo(display, resources, output)
        crtc = info.contents.crtc if info else None
        if info:
            randr.XRRFreeOutputInfo(info)
        state = randr.XRRGetCrtcInfo(display, resources, crtc) if crtc else None
        if not state:
            return None
        place = state.contents
        refresh_hz = {mode.id: refresh_rate_hz(mode) for mode in resources.contents.modes[: resources.contents.nmode]}
        output_now = OutputState(
            Rectangle(place.x, place.y, place.width, place.height),
            refresh_hz.get(place.mode, 0.0),
            _property(x11, randr, display, output, x11.XInternAtom(display, b"EDID", 0)),
        )
        randr.XRRFreeCrtcInfo(state)
        return output_now
    finally:
        randr.XRRFreeScreenResources(resources)


def refresh_rate_hz(mode: Mode) -> float:
    """Return how often a mode shows a picture, or a field of an interlaced one. 0 if unknown."""
    interlaced, double_scan = 0x10, 0x20
    lines = mode.v_total * (2.0 if mode.flags & double_scan else 1.0) / (2.0 if mode.flags & interlaced else 1.0)
    return float(mode.dot_clock / (mode.h_total * lines)) if mode.h_total and lines else 0.0


def _property(x11: ctypes.CDLL, randr: ctypes.CDLL, display: int, output: int, atom: int) -> bytes:
    kind, form, count, left = c_ulong(), c_int(), c_ulong(), c_ulong()
    data = POINTER(c_ubyte)()
    any_type, longs = 0, 256
    status = randr.XRRGetOutputProperty(
        display, output, atom, 0, longs, 0, 0, any_type,
        byref(kind), byref(form), byref(count), byref(left), byref(data),
    )  # fmt: skip
    if status != 0 or not data:
        return b""
    value = bytes(data[: count.value]) if form.value == 8 else b""
    x11.XFree(data)
    return value
