"""The little of Xlib and RandR that GLFW does not offer: EDIDs by connector, and surviving X's errors.

Bound by ctypes to libraries that GLFW needs anyway. By default Xlib ends the process on any error.
"""

from __future__ import annotations

import ctypes
import functools
import logging
from collections.abc import Callable
from ctypes import POINTER, byref, c_char_p, c_int, c_long, c_ubyte, c_ulong, c_ushort, c_void_p

log = logging.getLogger("phasestack.panels")

ErrorHandler = ctypes.CFUNCTYPE(c_int, c_void_p, c_void_p)
IOErrorHandler = ctypes.CFUNCTYPE(c_int, c_void_p)
ExitHandler = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)


class _Resources(ctypes.Structure):
    _fields_ = (
        ("timestamp", c_ulong),
        ("config_timestamp", c_ulong),
        ("ncrtc", c_int),
        ("crtcs", POINTER(c_ulong)),
        ("noutput", c_int),
        ("outputs", POINTER(c_ulong)),
    )


class _Output(ctypes.Structure):
    _fields_ = (
        ("timestamp", c_ulong),
        ("crtc", c_ulong),
        ("name", c_char_p),
        ("name_length", c_int),
        ("mm_width", c_ulong),
        ("mm_height", c_ulong),
        ("connection", c_ushort),
    )


@functools.cache
def _libraries() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    x11, randr = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXrandr.so.2")
    x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = c_void_p, [c_char_p]
    x11.XCloseDisplay.argtypes = [c_void_p]
    x11.XDefaultRootWindow.restype, x11.XDefaultRootWindow.argtypes = c_ulong, [c_void_p]
    x11.XInternAtom.restype, x11.XInternAtom.argtypes = c_ulong, [c_void_p, c_char_p, c_int]
    x11.XFree.argtypes = [c_void_p]
    x11.XSetErrorHandler.restype, x11.XSetErrorHandler.argtypes = c_void_p, [ErrorHandler]
    randr.XRRGetScreenResourcesCurrent.restype = POINTER(_Resources)
    randr.XRRGetScreenResourcesCurrent.argtypes = [c_void_p, c_ulong]
    randr.XRRFreeScreenResources.argtypes = [POINTER(_Resources)]
    randr.XRRGetOutputInfo.restype = POINTER(_Output)
    randr.XRRGetOutputInfo.argtypes = [c_void_p, POINTER(_Resources), c_ulong]
    randr.XRRFreeOutputInfo.argtypes = [POINTER(_Output)]
    randr.XRRGetOutputProperty.argtypes = [
        c_void_p, c_ulong, c_ulong, c_long, c_long, c_int, c_int, c_ulong,
        POINTER(c_ulong), POINTER(c_int), POINTER(c_ulong), POINTER(c_ulong), POINTER(POINTER(c_ubyte)),
    ]  # fmt: skip
    return x11, randr


def _note_error(_display: int, _event: int) -> int:
    log.warning("the X server refused a request")
    return 0


def _note_io_error(_display: int) -> int:
    log.warning("the connection to the X server broke")
    return 0


# Xlib keeps their addresses for the life of the process.
_ERROR_HANDLER = ErrorHandler(_note_error)
_IO_ERROR_HANDLER = IOErrorHandler(_note_io_error)


def survive_errors() -> None:
    """From now on a refused X request (a monitor that vanished meanwhile) is logged; it does not end the process."""
    _libraries()[0].XSetErrorHandler(_ERROR_HANDLER)


def survive_server(display: int, lost: Callable[[], None]) -> object:
    """Call `lost` when this display's server dies, in place of exit(). Keep the answer as long as the display.

    Answers None where libX11 is older than 1.7 and can't: then the process ends, and its supervisor restarts it.
    """
    x11 = _libraries()[0]
    if not hasattr(x11, "XSetIOErrorExitHandler"):
        return None

    x11.XSetIOErrorHandler.argtypes = [IOErrorHandler]
    x11.XSetIOErrorHandler(_IO_ERROR_HANDLER)
    handler = ExitHandler(lambda _display, _data: lost())
    x11.XSetIOErrorExitHandler.argtypes = [c_void_p, ExitHandler, c_void_p]
    x11.XSetIOErrorExitHandler(display, handler, None)
    return handler


def edids() -> dict[str, bytes]:
    """EDID of every output that has one, by connector name; empty where no X server answers."""
    try:
        x11, randr = _libraries()
    except OSError:
        return {}
    survive_errors()
    display = x11.XOpenDisplay(None)
    if not display:
        return {}
    found = {}
    try:
        edid = x11.XInternAtom(display, b"EDID", 0)
        resources = randr.XRRGetScreenResourcesCurrent(display, x11.XDefaultRootWindow(display))
        if not resources:
            return {}
        for output in resources.contents.outputs[: resources.contents.noutput]:
            info = randr.XRRGetOutputInfo(display, resources, output)
            if not info:
                continue
            data = _property(x11, randr, display, output, edid)
            if data:
                found[info.contents.name.decode()] = data
            randr.XRRFreeOutputInfo(info)
        randr.XRRFreeScreenResources(resources)
    finally:
        x11.XCloseDisplay(display)
    return found


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
