"""The offscreen OpenGL context: EGL with any driver (Mesa's llvmpipe at least)."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from runtime.errors import MissingPart
from runtime.records import U8
from runtime.support.extras import missing_extra

if TYPE_CHECKING:
    import moderngl

DEBIAN_PACKAGES = "libegl1 libgl1-mesa-dri libgles2 libgl1"
MINIMUM_VERSION = 330  # of OpenGL, times 100: the shaders' version
# Libraries by their sonames: the search that moderngl does otherwise starts a compiler and costs 60 ms.
EGL: dict[str, Any] = {"backend": "egl", "libegl": "libEGL.so.1", "libgl": "libGL.so.1"}


def offscreen_context() -> moderngl.Context:
    """An offscreen context, current on this thread, shared by content and offscreen panels.

    Use it on one thread only. Raises MissingPart, naming Debian's packages, where EGL can't give OpenGL 3.3.
    """
    try:
        import moderngl
    except ImportError as error:
        raise missing_extra(error) or error from None

    if "MESA_SHADER_CACHE_DIR" not in os.environ:  # nothing is left in a home: ours compile in milliseconds
        os.environ["MESA_SHADER_CACHE_DISABLE"] = "true"
    try:
        return moderngl.create_context(require=MINIMUM_VERSION, standalone=True, **EGL)
    except Exception as error:  # moderngl and glcontext raise plain Exception
        raise MissingPart(
            f"no OpenGL without a screen ({str(error).strip() or 'EGL failed'}): "
            f"install Debian's packages {DEBIAN_PACKAGES}"
        ) from None


def leave_context() -> None:
    """Make no context current on this thread: a current one that is released would leak."""
    egl, pointer = ctypes.CDLL(EGL["libegl"]), ctypes.c_void_p
    egl.eglGetCurrentDisplay.restype, egl.eglMakeCurrent.argtypes = pointer, [pointer] * 4
    egl.eglMakeCurrent(egl.eglGetCurrentDisplay(), None, None, None)


@cache
def _gl_finish() -> Any:
    return ctypes.CDLL(EGL["libgl"]).glFinish


def finish() -> None:
    """Wait until this thread's GL commands are complete, without holding Python's lock.

    moderngl's own calls keep the interpreter's lock: reading a picture that a software rasteriser still draws would
    hold every other thread up for tens of milliseconds.
    """
    _gl_finish()()


@dataclass(frozen=True, slots=True)
class DrawnPicture:
    """An RGBA picture of 8 bits that is left where it was drawn; row 0 is the top."""

    texture: moderngl.Texture
    target: moderngl.Framebuffer  # that the texture is in
    held: U8  # (h, w, 4) of whoever drew it, for those who want the pixels
    grey: bool = False  # whether it is known to be without colour

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w, 4)."""
        return self.held.shape

    def pixels(self) -> U8:
        """(h, w, 4) what was drawn, read back on the thread of its context; until the next is drawn."""
        finish()
        self.target.read_into(self.held, components=4)
        return self.held


def describe(context: moderngl.Context) -> dict[str, str]:
    """Vendor, renderer and version as the driver names them."""
    info = context.info
    return {
        "vendor": str(info["GL_VENDOR"]),
        "renderer": str(info["GL_RENDERER"]),
        "version": str(info["GL_VERSION"]),
    }
