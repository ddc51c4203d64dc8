"""OpenGL contexts on several threads that share textures, and layers that are left in such textures."""

from __future__ import annotations

import ctypes
import logging
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import moderngl
import numpy as np

from runtime.errors import ContextLost, MissingPart
from runtime.records import U8, Layers
from runtime.support.gl import EGL, MINIMUM_VERSION

log = logging.getLogger("phasestack.gl")

OPENGL_API, NONE = 0x30A2, 0x3038
CONFIG_ID, EXTENSIONS, DRAW, READ = 0x3028, 0x3055, 0x3059, 0x305A
MAJOR, MINOR, PROFILE_MASK, CORE_PROFILE = 0x3098, 0x30FB, 0x30FD, 1
RESET_STRATEGY, LOSE_ON_RESET = 0x31BD, 0x31BF
ROBUST_ACCESS_FLAGS = (0x30FC, 0x4)
GL_RESET_STRATEGY, GL_LOSE_ON_RESET = 0x8256, 0x8252
GL_TEXTURE_2D, GL_RGBA, GL_UNSIGNED_BYTE = 0x0DE1, 0x1908, 0x1401
GL_COMMANDS_COMPLETE, GL_FLUSH_FIRST, GL_TIMED_OUT, GL_WAIT_FAILED = 0x9117, 1, 0x911B, 0x911D
WAIT_NS = 100_000_000  # for a fence, at a time
SIZES_KEPT = 6  # of layers


@cache
def _egl() -> Any:
    """libEGL, which is loaded once OpenGL is in use. Raises MissingPart."""
    try:
        library = ctypes.CDLL(EGL["libegl"])
    except OSError as error:
        raise MissingPart(f"no EGL: {error}") from None
    pointer, whole = ctypes.c_void_p, ctypes.c_int
    for name, answer, given in (
        ("eglBindAPI", whole, [ctypes.c_uint]),
        ("eglGetCurrentDisplay", pointer, []),
        ("eglGetCurrentContext", pointer, []),
        ("eglGetCurrentSurface", pointer, [whole]),
        ("eglQueryContext", whole, [pointer, pointer, whole, ctypes.POINTER(whole)]),
        ("eglQueryString", ctypes.c_char_p, [pointer, whole]),
        ("eglChooseConfig", whole, [pointer, ctypes.POINTER(whole), ctypes.POINTER(pointer), whole,
                                    ctypes.POINTER(whole)]),
        ("eglCreateContext", pointer, [pointer, pointer, pointer, ctypes.POINTER(whole)]),
        ("eglMakeCurrent", whole, [pointer, pointer, pointer, pointer]),
        ("eglDestroyContext", whole, [pointer, pointer]),
        ("eglGetProcAddress", pointer, [ctypes.c_char_p]),
        ("eglGetError", whole, []),
    ):  # fmt: skip
        function = getattr(library, name)
        function.restype, function.argtypes = answer, given
    return library


@cache
def _gl(name: str, answer: Any, *given: Any) -> Any:
    """A function of OpenGL; while it runs other Python threads do, too."""
    address = _egl().eglGetProcAddress(name.encode())
    if not address:
        raise MissingPart(f"this OpenGL driver lacks {name}")
    return ctypes.CFUNCTYPE(answer, *given)(address)


@cache
def gl_function(name: str) -> int:
    """Of an OpenGL function, the same in every context; 0: there is none.

    Kept: moderngl never lets go of the numbers that it is given, 20 KiB a context.
    """
    found: int | None = _egl().eglGetProcAddress(name.encode())
    return found or 0


class SharingContext:
    """What moderngl needs to know of a context of a group: where its functions are, and how it becomes current."""

    def __init__(self, display: int, share: int, *, loses_on_reset: bool) -> None:
        """Raises MissingPart where the driver makes none."""
        egl, whole = _egl(), ctypes.c_int
        egl.eglBindAPI(OPENGL_API)
        wanted = [MAJOR, MINIMUM_VERSION // 100, MINOR, MINIMUM_VERSION // 10 % 10, PROFILE_MASK, CORE_PROFILE]
        if loses_on_reset:  # all contexts of a group must answer alike to a reset
            wanted += [*ROBUST_ACCESS_FLAGS, RESET_STRATEGY, LOSE_ON_RESET]
        number, count, config = whole(), whole(), ctypes.c_void_p()
        egl.eglQueryContext(display, share, CONFIG_ID, ctypes.byref(number))
        if number.value:
            like = (whole * 3)(CONFIG_ID, number.value, NONE)
            egl.eglChooseConfig(display, like, ctypes.byref(config), 1, ctypes.byref(count))
        self._display = display
        self._context = egl.eglCreateContext(display, config, share, (whole * (len(wanted) + 1))(*wanted, NONE))
        if not self._context:
            raise MissingPart(f"this OpenGL driver makes no context that shares (EGL 0x{egl.eglGetError():x})")

    def load_opengl_function(self, name: str) -> int:
        """Address of an OpenGL function; 0: there is none."""
        return gl_function(name)

    load = load_opengl_function

    def __enter__(self) -> None:
        if not _egl().eglMakeCurrent(self._display, None, None, self._context):
            raise ContextLost(f"OpenGL: a context can't be made current (EGL 0x{_egl().eglGetError():x})")

    def __exit__(self, *exception: object) -> None:
        """Leaves it current: whoever needs another makes that current."""

    def release(self) -> None:
        """Textures of the group stay. May be called twice."""
        if self._context:
            if _egl().eglGetCurrentContext() == self._context:
                _egl().eglMakeCurrent(self._display, None, None, None)
            _egl().eglDestroyContext(self._display, self._context)
            self._context = None


class ShareGroup:
    """Contexts that share textures. Any thread may ask for one of its own, and read textures."""

    def __init__(self) -> None:
        """Of the context that is current on this thread. Raises MissingPart where that is none of EGL's, or where the
        driver can't have contexts without a surface."""
        egl = _egl()
        egl.eglBindAPI(OPENGL_API)
        self._display, self._first = egl.eglGetCurrentDisplay(), egl.eglGetCurrentContext()
        if not self._first:
            raise MissingPart("no context of EGL is current")
        if b"EGL_KHR_surfaceless_context" not in (egl.eglQueryString(self._display, EXTENSIONS) or b""):
            raise MissingPart("this OpenGL driver can't share without a surface")
        strategy = ctypes.c_int()
        _gl("glGetIntegerv", None, ctypes.c_uint, ctypes.POINTER(ctypes.c_int))(
            GL_RESET_STRATEGY, ctypes.byref(strategy)
        )
        _gl("glGetError", ctypes.c_uint)()  # of a driver that does not know what that is
        self._loses_on_reset = strategy.value == GL_LOSE_ON_RESET
        self._lock = threading.Lock()
        self._own: SharingContext | None = None
        self._discarded: list[Any] = []
        self.lost = False  # its textures are no more

    def context(self) -> moderngl.Context:
        """Another context of the group, current on this thread. Raises MissingPart."""
        sharing = self.stand_in()
        given: dict[str, Any] = {"context": sharing}
        made = moderngl.create_context(require=MINIMUM_VERSION, **given)
        made.extra = sharing
        return made

    def stand_in(self) -> SharingContext:
        """Another context, current on this thread, to release in what another one of the group made. moderngl knows
        nothing of it: it would keep 16 KiB for good. Raises MissingPart."""
        sharing = self._sharing()
        sharing.__enter__()
        return sharing

    def read_into(self, texture: Any, out: U8) -> None:
        """Read a texture (moderngl's, RGBA in 8 bits) back into (h, w, 4), on any thread. Raises ContextLost."""
        with self.borrowed():
            _gl("glBindTexture", None, ctypes.c_uint, ctypes.c_uint)(GL_TEXTURE_2D, texture.glo)
            read_texture(out)

    @contextmanager
    def borrowed(self) -> Iterator[None]:
        """The group's own context on this thread for a while, then the one before it. Raises ContextLost."""
        with self._lock:
            if self.lost:
                raise ContextLost("OpenGL: the textures went with their context")
            if self._own is None:
                self._own = self._sharing()
            with _current(self._own):
                yield

    def discard(self, textures: Sequence[Any]) -> None:
        """Have textures released that nobody uses any more, by whoever of the group is next (`collect`)."""
        self._discarded.extend(textures)

    def collect(self) -> None:
        """Release what was discarded. A context of the group is current on this thread."""
        while self._discarded:
            self._discarded.pop().release()

    def close(self) -> None:
        """Its textures are no more: whoever asks for one is told so. May be called twice."""
        with self._lock:
            self.lost = True
            if self._own is not None:
                self._own.release()
                self._own = None

    def _sharing(self) -> SharingContext:
        return SharingContext(self._display, self._first, loses_on_reset=self._loses_on_reset)


def shared() -> ShareGroup | None:
    """The group of the context that is current on this thread; None where it can't share, which the log is told."""
    try:
        return ShareGroup()
    except MissingPart as error:
        log.info("solutions are read back and uploaded again: %s", error)
        return None


def leave_context() -> None:
    """Have no context current on this thread: one that is released while it is current stays as long as the process."""
    egl = _egl()
    egl.eglBindAPI(OPENGL_API)
    if egl.eglGetCurrentContext():
        egl.eglMakeCurrent(egl.eglGetCurrentDisplay(), None, None, None)


def read_texture(out: U8) -> None:
    """Read the texture that is bound back into (h, w, 4)."""
    _gl("glGetTexImage", None, ctypes.c_uint, ctypes.c_int, ctypes.c_uint, ctypes.c_uint, ctypes.c_void_p)(
        GL_TEXTURE_2D, 0, GL_RGBA, GL_UNSIGNED_BYTE, out.ctypes.data
    )


@contextmanager
def _current(context: SharingContext) -> Iterator[None]:
    """A context on this thread, and afterwards the one that was."""
    egl = _egl()
    egl.eglBindAPI(OPENGL_API)
    display, before = egl.eglGetCurrentDisplay(), egl.eglGetCurrentContext()
    drawn, read = egl.eglGetCurrentSurface(DRAW), egl.eglGetCurrentSurface(READ)
    context.__enter__()
    try:
        yield
    finally:
        if before:
            egl.eglMakeCurrent(display, drawn, read, before)
        else:
            egl.eglMakeCurrent(context._display, None, None, None)


def wait_until_drawn() -> None:
    """Wait for a fence behind all that was drawn in this thread's context: other contexts may use it then.

    Other Python threads run meanwhile. Raises ContextLost.
    """
    fence = _gl("glFenceSync", ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint)(GL_COMMANDS_COMPLETE, 0)
    if not fence:
        raise ContextLost("OpenGL: no fence can be set")
    wait = _gl("glClientWaitSync", ctypes.c_uint, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint64)
    try:
        while (answer := wait(fence, GL_FLUSH_FIRST, WAIT_NS)) == GL_TIMED_OUT:
            pass
    finally:
        _gl("glDeleteSync", None, ctypes.c_void_p)(fence)
    if answer == GL_WAIT_FAILED:
        raise ContextLost("OpenGL: a fence was lost")


class LayerTextures:
    """Layers in textures of a group, one a panel, rear to front: RGBA in 8 bits, row 0 the top.

    They are complete, and drawn over only when nobody holds this any more.
    """

    def __init__(self, group: ShareGroup, textures: tuple[Any, ...]) -> None:
        self.group, self.textures = group, textures
        self._pixels: U8 | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """(N, h, w, 4)."""
        width, height = self.textures[0].size
        return len(self.textures), height, width, 4

    @property
    def lost(self) -> bool:
        """Whether they went with their group's context."""
        return self._pixels is None and self.group.lost

    def pixels(self) -> U8:
        """(N, h, w, 4), read back when it is first asked for, on any thread. Raises ContextLost."""
        if self._pixels is None:
            pixels = np.empty(self.shape, np.uint8)
            for texture, layer in zip(self.textures, pixels, strict=True):
                self.group.read_into(texture, layer)
            pixels.setflags(write=False)
            self._pixels = pixels
        return self._pixels


class LayerPool:
    """Textures for layers: as many as are held at once. Used on one thread, with its context current."""

    def __init__(self, context: Any, group: ShareGroup) -> None:
        self._context, self.group = context, group
        self._sets: list[tuple[tuple[Any, ...], weakref.ref[LayerTextures]]] = []

    def taken(self, count: int, *, width_px: int, height_px: int) -> LayerTextures:
        """Textures that are nobody else's as long as the answer lives; what is in them is left over."""
        self.group.collect()
        free = [textures for textures, holder in self._sets if holder() is None]
        size = (width_px, height_px)
        for textures in free:
            if len(textures) == count and textures[0].size == size:
                break
        else:
            textures = tuple(self._context.texture(size, 4) for _ in range(count))
            for texture in textures:
                texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
                texture.repeat_x = texture.repeat_y = False
        layers = LayerTextures(self.group, textures)
        # The newest last: those that are free for long are the first to go.
        self._sets = [one for one in self._sets if one[0] is not textures] + [(textures, weakref.ref(layers))]
        return layers

    def surplus(self) -> list[tuple[Any, ...]]:
        """Textures of sizes that have not been asked for lately; they are the caller's to release."""
        sizes = list(dict.fromkeys(textures[0].size for textures, _ in reversed(self._sets)))
        gone = [one for one in self._sets if one[1]() is None and one[0][0].size in sizes[SIZES_KEPT:]]
        self._sets = [one for one in self._sets if one not in gone]
        return [textures for textures, _ in gone]

    def close(self) -> None:
        """Release those that nobody holds; the others when they are let go. May be called twice."""
        for textures, holder in self._sets:
            held = holder()
            if held is None:
                self.group.discard(textures)
            else:
                weakref.finalize(held, self.group.discard, textures)
        self._sets = []
        self.group.collect()

    @property
    def count(self) -> int:
        """How many textures there are."""
        return sum(len(textures) for textures, _ in self._sets)


def lies_in(layers: Layers | None, group: ShareGroup | None) -> bool:
    """Whether a context of a group can sample these layers where they are."""
    return group is not None and isinstance(layers, LayerTextures) and layers.group is group
