"""What crosses between OpenGL and the processor, counted where it is called: in the driver's functions themselves."""

from __future__ import annotations

import ctypes
import threading
from typing import Any

import pytest

from runtime.panels.display import WindowContext
from runtime.support import gl_sharing
from runtime.support.gl_sharing import SharingContext

_UINT, _INT, _POINTER = ctypes.c_uint, ctypes.c_int, ctypes.c_void_p
READS: dict[str, tuple[Any, ...]] = {
    "glReadPixels": (None, _INT, _INT, _INT, _INT, _UINT, _UINT, _POINTER),
    "glGetTexImage": (None, _UINT, _INT, _UINT, _UINT, _POINTER),
    "glGetBufferSubData": (None, _UINT, ctypes.c_ssize_t, ctypes.c_ssize_t, _POINTER),
    "glMapBuffer": (_POINTER, _UINT, _UINT),
    "glMapBufferRange": (_POINTER, _UINT, ctypes.c_ssize_t, ctypes.c_ssize_t, _UINT),
}
WRITES: dict[str, tuple[Any, ...]] = {  # up: the last argument is where the pixels are, if there are any
    "glTexImage2D": (None, _UINT, _INT, _INT, _INT, _INT, _INT, _UINT, _UINT, _POINTER),
    "glTexSubImage2D": (None, _UINT, _INT, _INT, _INT, _INT, _INT, _UINT, _UINT, _POINTER),
}
SIZES = {"glReadPixels": slice(2, 4), "glTexImage2D": slice(3, 5), "glTexSubImage2D": slice(4, 6)}


class Counted:
    """Calls of contexts that are made from now on, and of whoever reads a texture of a group."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        # function, size in pixels where it says so, thread
        self.calls: list[tuple[str, tuple[int, ...], str]] = []  # that read
        self.uploads: list[tuple[str, tuple[int, ...], str]] = []
        self._held: list[Any] = []  # what C calls must live on
        for kind in (SharingContext, WindowContext):
            load = kind.load_opengl_function
            for name in ("load", "load_opengl_function"):
                monkeypatch.setattr(kind, name, self._loader(load))
        read = gl_sharing.read_texture

        def noted(out: Any) -> None:
            self._note(self.calls, "glGetTexImage", out.shape[1::-1])
            read(out)

        monkeypatch.setattr(gl_sharing, "read_texture", noted)

    def _loader(self, load: Any) -> Any:
        def loaded(context: Any, name: str) -> int:
            address: int = load(context, name)
            return self._wrapped(name, address) if address and name in READS | WRITES else address

        return loaded

    def _wrapped(self, name: str, address: int) -> int:
        kind = ctypes.CFUNCTYPE(*(READS | WRITES)[name])
        real = kind(address)

        def call(*given: Any) -> Any:
            if name in READS or given[-1] is not None:
                self._note(self.uploads if name in WRITES else self.calls, name, given[SIZES.get(name, slice(0))])
            return real(*given)

        self._held += [wrapped := kind(call), real]
        return ctypes.cast(wrapped, ctypes.c_void_p).value or 0

    @staticmethod
    def _note(into: list[tuple[str, tuple[int, ...], str]], name: str, size: tuple[int, ...]) -> None:
        into.append((name, tuple(size), threading.current_thread().name))
