"""Pictures in memory shared with the X server, using X's MIT-SHM extension through ctypes.

The X server copies such a picture to its window without it passing through the connection.
"""

from __future__ import annotations

import ctypes
import functools
import os
from ctypes import POINTER, byref, c_char_p, c_int, c_uint, c_ulong, c_void_p
from typing import Any

import numpy as np

from runtime.optics.rect import PixelRect
from runtime.panels import xlib
from runtime.records import U8

PRIVATE, OWNER_ONLY, REMOVE = 0, 0o600, 0  # arguments of shmget and shmctl
Z_PIXMAP, ALL_PLANES = 2, 0xFFFFFFFF
# The picture's first byte in its segment. On an AMD Zen 3 processor, the X server's copy takes 1.5 times as long if
# the rows' addresses are just below their destinations modulo 4 KiB, as with a picture at the start of a page.
FIRST_BYTE = 128


class NotShared(Exception):
    """Memory cannot be shared with the X server, for example because it runs on another computer."""


class _Segment(ctypes.Structure):
    _fields_ = (("segment", c_ulong), ("id", c_int), ("address", c_void_p), ("read_only", c_int))


class _Visual(ctypes.Structure):
    """First fields of Xlib's `Visual`."""

    _fields_ = (
        ("extension_data", c_void_p), ("id", c_ulong), ("kind", c_int),
        ("red_mask", c_ulong), ("green_mask", c_ulong), ("blue_mask", c_ulong),
    )  # fmt: skip


class _Image(ctypes.Structure):
    """First fields of Xlib's `XImage`."""

    _fields_ = (
        *((name, c_int) for name in ("width", "height", "offset", "format")), ("data", c_void_p),
        *((name, c_int) for name in ("byte_order", "unit", "bit_order", "pad", "depth", "stride", "pixel_bits")),
    )  # fmt: skip


@functools.cache
def _libraries() -> tuple[ctypes.CDLL, ctypes.CDLL, ctypes.CDLL]:
    x11, extensions, system = (
        ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXext.so.6"), ctypes.CDLL(None, use_errno=True)
    )  # fmt: skip
    x11.XDefaultScreen.argtypes = [c_void_p]
    x11.XDefaultDepth.argtypes = [c_void_p, c_int]
    x11.XDefaultVisual.restype, x11.XDefaultVisual.argtypes = POINTER(_Visual), [c_void_p, c_int]
    x11.XCreateGC.restype, x11.XCreateGC.argtypes = c_void_p, [c_void_p, c_ulong, c_ulong, c_void_p]
    x11.XFreeGC.argtypes = [c_void_p, c_void_p]
    x11.XSync.argtypes = [c_void_p, c_int]
    x11.XFree.argtypes = [c_void_p]
    x11.XCreatePixmap.restype, x11.XCreatePixmap.argtypes = c_ulong, [c_void_p, c_ulong, c_uint, c_uint, c_uint]
    x11.XFreePixmap.argtypes = [c_void_p, c_ulong]
    x11.XGetImage.restype = POINTER(_Image)
    x11.XGetImage.argtypes = [c_void_p, c_ulong, c_int, c_int, c_uint, c_uint, c_ulong, c_int]
    x11.XDestroyImage.argtypes = [POINTER(_Image)]
    extensions.XShmQueryExtension.argtypes = [c_void_p]
    extensions.XShmCreateImage.restype = POINTER(_Image)
    extensions.XShmCreateImage.argtypes = [
        c_void_p, POINTER(_Visual), c_uint, c_int, c_char_p, POINTER(_Segment), c_uint, c_uint,
    ]  # fmt: skip
    extensions.XShmAttach.argtypes = extensions.XShmDetach.argtypes = [c_void_p, POINTER(_Segment)]
    system.shmget.argtypes = [c_int, ctypes.c_size_t, c_int]
    system.shmat.restype, system.shmat.argtypes = c_void_p, [c_int, c_void_p, c_int]
    system.shmdt.argtypes = [c_void_p]
    system.shmctl.argtypes = [c_int, c_int, c_void_p]
    return x11, extensions, system


@functools.cache
def _short_calls() -> tuple[ctypes.PyDLL, ctypes.PyDLL]:
    """Return the libraries of functions that only write to the connection. They keep Python's global lock, because
    waiting for it again takes milliseconds if another thread, such as the black box's, is busy.
    """
    x11, extensions = ctypes.PyDLL("libX11.so.6"), ctypes.PyDLL("libXext.so.6")
    x11.XFlush.argtypes = [c_void_p]
    extensions.XShmPutImage.argtypes = [
        c_void_p, c_ulong, c_void_p, POINTER(_Image), c_int, c_int, c_int, c_int, c_uint, c_uint, c_int,
    ]  # fmt: skip
    return x11, extensions


class SharedPicture:
    """A picture that fills a window."""

    def __init__(self, display: int, window: int, *, width_px: int, height_px: int) -> None:
        """Create a black picture for a window with the default visual. Raises NotShared if memory cannot be shared with
        the X server, or its pixels are not 32-bit BGRX.
        """
        self._display, self._window = display, window
        self._segment = _Segment()
        self._image: Any = None  # pointer to an XImage
        self._context: int | None = None
        self._attached = False
        try:
            self._open(width_px, height_px)
        except BaseException:
            self.close()
            raise

    def put(self, part: PixelRect | None = None) -> None:
        """Ask the X server to copy the picture, or part of it, to its window. `finish` waits for it."""
        image = self._image.contents
        part = part or PixelRect(0, 0, image.width, image.height)
        at, size = (part.u0, part.v0), (part.width_px, part.height_px)
        _, extensions = _short_calls()
        extensions.XShmPutImage(self._display, self._window, self._context, self._image, *at, *at, *size, 0)

    def close(self) -> None:
        """Release the memory. May be called more than once. `pixels` must not be used afterwards."""
        x11, extensions, system = _libraries()
        if self._attached:
            extensions.XShmDetach(self._display, byref(self._segment))
            finish(self._display)
        if self._context:
            x11.XFreeGC(self._display, self._context)
        if self._image:
            x11.XFree(self._image)
        if self._segment.address:
            system.shmdt(self._segment.address)
        self._segment, self._image, self._context = _Segment(), None, None
        self._attached = False

    def _open(self, width_px: int, height_px: int) -> None:
        x11, extensions, system = _libraries()
        if not extensions.XShmQueryExtension(self._display):
            raise NotShared("the X server has no MIT-SHM extension")
        screen = x11.XDefaultScreen(self._display)
        visual = x11.XDefaultVisual(self._display, screen)
        self._image = extensions.XShmCreateImage(
            self._display, visual, x11.XDefaultDepth(self._display, screen), Z_PIXMAP, None, byref(self._segment),
            width_px, height_px,
        )  # fmt: skip
        if not self._image:
            raise NotShared("the X server cannot create a shared picture")
        image = self._image.contents
        masks = visual.contents.red_mask, visual.contents.green_mask, visual.contents.blue_mask
        if image.pixel_bits != 32 or image.stride != 4 * width_px or masks != (0xFF0000, 0xFF00, 0xFF):
            raise NotShared("the X server's pixels are not 32-bit BGRX")
        self._segment.id = system.shmget(PRIVATE, FIRST_BYTE + image.stride * height_px, OWNER_ONLY)
        if self._segment.id < 0:
            raise NotShared(f"no shared memory: {os.strerror(ctypes.get_errno())}")
        address = system.shmat(self._segment.id, None, 0)
        if address in (None, c_void_p(-1).value):
            system.shmctl(self._segment.id, REMOVE, None)
            raise NotShared(f"no shared memory: {os.strerror(ctypes.get_errno())}")
        self._segment.address, image.data = address, address + FIRST_BYTE
        finish(self._display)  # so that only this request is counted
        refused = xlib.refusals()
        self._attached = bool(extensions.XShmAttach(self._display, byref(self._segment)))
        finish(self._display)
        system.shmctl(self._segment.id, REMOVE, None)  # takes effect once the server and this process have let go
        if not self._attached or xlib.refusals() != refused:
            self._attached = False
            raise NotShared("the X server cannot reach this process's memory")
        self._context = x11.XCreateGC(self._display, self._window, 0, None)
        if self._pixel_read_back(x11) != ctypes.c_uint32.from_address(image.data).value:
            raise NotShared("the X server cannot reach this process's memory")
        content = (ctypes.c_uint8 * (image.stride * height_px)).from_address(image.data)
        self.pixels: U8 = np.frombuffer(content, np.uint8).reshape(height_px, width_px, 4)  # BGRX
        self.pixels[:] = 0

    def _pixel_read_back(self, x11: ctypes.CDLL) -> int | None:
        """Return the first pixel as the X server finds it, after setting it to a random value. A server in another IPC
        namespace may have attached a different segment, which has the same number there.
        """
        depth, at, size = self._image.contents.depth, (0, 0), (1, 1)
        ctypes.c_uint32.from_address(self._image.contents.data).value = int.from_bytes(os.urandom(3), "little")
        pixmap = x11.XCreatePixmap(self._display, self._window, *size, depth)
        _, extensions = _short_calls()
        extensions.XShmPutImage(self._display, pixmap, self._context, self._image, *at, *at, *size, 0)
        copy = x11.XGetImage(self._display, pixmap, *at, *size, ALL_PLANES, Z_PIXMAP)
        x11.XFreePixmap(self._display, pixmap)
        if not copy:
            return None
        pixel = ctypes.c_uint32.from_address(copy.contents.data).value & 0xFFFFFF
        x11.XDestroyImage(copy)
        return int(pixel)


def finish(display: int) -> None:
    """Wait until the X server has carried out every request."""
    x11, _, _ = _libraries()
    x11.XSync(display, 0)


def flush(display: int) -> None:
    """Send all requests to the X server without waiting for them."""
    x11, _ = _short_calls()
    x11.XFlush(display)
