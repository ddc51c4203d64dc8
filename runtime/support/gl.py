"""Offscreen OpenGL context through EGL, with any driver (at least Mesa's llvmpipe)."""

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
MINIMUM_VERSION = 330  # OpenGL version times 100, as the shaders require
# Sonames avoid moderngl's search for libraries, which starts a compiler and takes 60 ms.
EGL: dict[str, Any] = {"backend": "egl", "libegl": "libEGL.so.1", "libgl": "libGL.so.1"}


def offscreen_context() -> moderngl.Context:
    """Create an offscreen context and make it current. Content and offscreen panels share it.

    Use it on one thread only. Raises MissingPart, naming Debian's packages, if EGL has no OpenGL 3.3.
    """
    try:
        import moderngl
    except ImportError as error:
        raise missing_extra(error) or error from None

    if "MESA_SHADER_CACHE_DIR" not in os.environ:  # no cache in the home folder; compiling takes milliseconds
        os.environ["MESA_SHADER_CACHE_DISABLE"] = "true"
    try:
        return moderngl.create_context(require=MINIMUM_VERSION, standalone=True, **EGL)
    except Exception as error:  # moderngl and glcontext raise plain Exception
        raise MissingPart(
            f"cannot create an OpenGL context without a screen: {str(error).strip() or 'EGL failed'}; "
            f"install the Debian packages {DEBIAN_PACKAGES}"
        ) from None


def leave_context() -> None:
    """Make no context current on this thread. Releasing a current one would leak it."""
    egl, pointer = ctypes.CDLL(EGL["libegl"]), ctypes.c_void_p
    egl.eglGetCurrentDisplay.restype, egl.eglMakeCurrent.argtypes = pointer, [pointer] * 4
    egl.eglMakeCurrent(egl.eglGetCurrentDisplay(), None, None, None)


@cache
def _gl_finish() -> Any:
    return ctypes.CDLL(EGL["libgl"]).glFinish


def finish() -> None:
    """Wait until this thread's GL commands are complete, without holding Python's lock.

    moderngl keeps the lock during its calls: reading a picture that a software rasteriser is still drawing would block
    all other threads for tens of milliseconds.
    """
    _gl_finish()()


@dataclass(frozen=True, slots=True)
class DrawnPicture:
    """8-bit RGBA picture on the GPU, with row 0 at the top."""

    texture: moderngl.Texture
    target: moderngl.Framebuffer  # contains `texture`
    held: U8  # (h, w, 4) the renderer's buffer for reading pixels back
    grey: bool = False  # True if known to be without colour

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w, 4)."""
        return self.held.shape

    def pixels(self) -> U8:
        """Return the pixels (h, w, 4), valid until the next drawing. Call on the thread of the context."""
        finish()
        self.target.read_into(self.held, components=4)
        return self.held


def describe(context: moderngl.Context) -> dict[str, str]:
    """Return the vendor, renderer and version that the driver reports."""
    info = context.info
    return {"vendor": str(info["GL_VENDOR"]), "renderer": str(info["GL_RENDERER"]), "version": str(info["GL_VERSION"])}
