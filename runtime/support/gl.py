"""Offscreen OpenGL contexts created through EGL. Mesa's software renderer (llvmpipe) is sufficient."""

from __future__ import annotations

import ctypes
import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from runtime.errors import MissingPart
from runtime.records import U8
from runtime.support.extras import missing_extra

if TYPE_CHECKING:
    import moderngl

DEBIAN_PACKAGES = "libegl1 libgl1-mesa-dri libgles2 libgl1"
DRIVER_BYTES = 256 << 20  # address space for llvmpipe and the libraries that it loads
MINIMUM_VERSION = 330  # OpenGL 3.3, which the shaders require
# Given these file names, moderngl need not search for the libraries; a search starts a compiler and takes 60 ms.
EGL: dict[str, Any] = {"backend": "egl", "libegl": "libEGL.so.1", "libgl": "libGL.so.1"}


def offscreen_context() -> moderngl.Context:
    """Create an offscreen OpenGL context for one thread, and make it current. Raises MissingPart, which
    names Debian packages, without OpenGL 3.3 by EGL, or MemoryError.
    """
    try:
        import moderngl
    except ImportError as error:
        raise missing_extra(error) or error from None

    if "MESA_SHADER_CACHE_DIR" not in os.environ:  # write no cache to the home folder; compiling takes milliseconds
        os.environ["MESA_SHADER_CACHE_DISABLE"] = "true"
    try:
        return moderngl.create_context(require=MINIMUM_VERSION, standalone=True, **EGL)
    except Exception as error:  # moderngl and glcontext raise plain Exception
        try:
            mmap.mmap(-1, DRIVER_BYTES).close()
        except OSError:
            raise MemoryError("there is too little memory for an OpenGL driver") from None
        raise MissingPart(
            f"cannot create an OpenGL context without a screen: {str(error).strip() or 'EGL failed'}; "
            f"install the Debian packages {DEBIAN_PACKAGES}"
        ) from None


def leave_context() -> None:
    """Detach the current context from this thread. Releasing a context while it is current would leak it."""
    egl, pointer = ctypes.CDLL(EGL["libegl"]), ctypes.c_void_p
    egl.eglGetCurrentDisplay.restype, egl.eglMakeCurrent.argtypes = pointer, [pointer] * 4
    egl.eglMakeCurrent(egl.eglGetCurrentDisplay(), None, None, None)


def set_uniforms(program: Any, values: Mapping[str, Any]) -> None:
    """Set uniforms by name, skipping any that the compiler has removed."""
    for name, value in values.items():
        if (uniform := program.get(name, None)) is not None:  # the operator `in` would try all names in turn
            uniform.value = value


@dataclass(frozen=True, slots=True)
class DrawnPicture:
    """8-bit RGBA picture on the GPU that can be read back. Row 0 is at the top."""

    texture: moderngl.Texture
    target: moderngl.Framebuffer  # framebuffer with `texture` attached
    held: U8  # (h, w, 4) the renderer's buffer that `pixels` reads into
    grey: bool = False  # True if the picture is known to have no colour

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the pixel array, (h, w, 4)."""
        return self.held.shape

    def pixels(self) -> U8:
        """Read back the pixels (h, w, 4), on the context's thread, valid until the next picture is drawn."""
        self.target.read_into(self.held, components=4)
        return self.held


def describe(context: moderngl.Context) -> dict[str, str]:
    """Return the vendor, renderer and version reported by the OpenGL driver."""
    info = context.info
    return {"vendor": str(info["GL_VENDOR"]), "renderer": str(info["GL_RENDERER"]), "version": str(info["GL_VERSION"])}


def draws_in_software(context: moderngl.Context) -> bool:
    """Return True if the OpenGL driver draws on the processor."""
    renderer = describe(context)["renderer"].lower()
    return any(name in renderer for name in ("llvmpipe", "softpipe", "swrast"))
