"""A pool of layer buffers: a solution is written where it stays, and nobody copies it."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import U8


@dataclass(eq=False)
class LayerBuffer:
    """Memory for one solution's layers."""

    pixels: U8  # (N, h, w, 4) RGBA, opaque
    outside: object = None  # key of what the pixels outside the solved boxes show; None: not known
    holder: Callable[[], U8 | None] = field(default=lambda: None)

    def handed_over(self) -> U8:
        """A read-only view; the buffer is free again once nobody holds it."""
        # Not `pixels.view()`: a slice of that would keep the buffer alive, but not the view that is watched.
        view: U8 = np.asarray(self.pixels.data.toreadonly())
        self.holder = weakref.ref(view)
        return view


class LayerPool:
    """As many buffers as are held at once: one being written, the newest, the one on the panels."""

    def __init__(self, stack: PanelStack) -> None:
        self._shape = stack.count, stack.height_px, stack.width_px, 4
        self._buffers: list[LayerBuffer] = []

    def take(self) -> LayerBuffer:
        """A buffer whose layers nobody holds any more, with its last contents; else a new one."""
        for buffer in self._buffers:
            if buffer.holder() is None:
                return buffer
        buffer = LayerBuffer(np.full(self._shape, 255, np.uint8))
        self._buffers.append(buffer)
        return buffer
