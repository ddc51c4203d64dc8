"""Layers that are left in textures: for a model's backend that is given a group. The daemon gives none."""

from __future__ import annotations

import ctypes
import weakref
from functools import cache
from typing import Any

import moderngl
import numpy as np

from runtime.errors import ContextLost
from runtime.records import U8
from runtime.support.gl import EGL

GL_COMMANDS_COMPLETE, GL_FLUSH_FIRST, GL_TIMED_OUT, GL_WAIT_FAILED = 0x9117, 1, 0x911B, 0x911D
WAIT_NS = 100_000_000  # for a fence, at a time
SIZES_KEPT = 6  # of layers


class ShareGroup:
    """Whose textures layers are left in."""

    lost = False

    def close(self) -> None:
        self.lost = True


@cache
def _gl(name: str, answer: Any, *given: Any) -> Any:
    """A function of OpenGL; while it runs other Python threads do, too."""
    function = getattr(ctypes.CDLL(EGL["libgl"]), name)
    function.restype, function.argtypes = answer, given
    return function


def wait_until_drawn() -> None:
    """Wait until all that was drawn in this thread's context is complete. Raises ContextLost."""
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
    """Layers in textures, one a panel, rear to front: RGBA in 8 bits, row 0 the top; nobody else's while this lives."""

    def __init__(self, group: ShareGroup, textures: tuple[Any, ...]) -> None:
        self.group, self.textures = group, textures

    @property
    def shape(self) -> tuple[int, ...]:
        """(N, h, w, 4)."""
        width, height = self.textures[0].size
        return len(self.textures), height, width, 4

    @property
    def lost(self) -> bool:
        """Whether they went with their group."""
        return self.group.lost

    def pixels(self) -> U8:
        """(N, h, w, 4), read back; on the thread of their context."""
        return np.stack([np.frombuffer(texture.read(), np.uint8) for texture in self.textures]).reshape(self.shape)


class LayerPool:
    """Textures for layers: as many as are held at once. Used on one thread, with its context current."""

    def __init__(self, context: Any, group: ShareGroup) -> None:
        self._context, self.group = context, group
        self._sets: list[tuple[tuple[Any, ...], weakref.ref[LayerTextures]]] = []

    def taken(self, count: int, *, width_px: int, height_px: int) -> LayerTextures:
        """Textures that are nobody else's as long as the answer lives; what is in them is left over."""
        size = (width_px, height_px)
        for textures, holder in self._sets:
            if holder() is None and len(textures) == count and textures[0].size == size:
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
        """Release them. May be called twice."""
        for textures, _ in self._sets:
            for texture in textures:
                texture.release()
        self._sets = []

    @property
    def count(self) -> int:
        """How many textures there are."""
        return sum(len(textures) for textures, _ in self._sets)
