"""A pool of layer buffers: a solution is written in place and never copied."""

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
    outside: object = None  # key of the pixels outside the solved boxes; None: unknown
    holder: Callable[[], U8 | None] = field(default=lambda: None)

    def handed_over(self) -> U8:
        """Return a read-only view; the buffer is free again once the view is gone."""
        # Not `pixels.view()`: a slice of that would keep the buffer alive, but not the view that is watched.
        view: U8 = np.asarray(self.pixels.data.toreadonly())
        self.holder = weakref.ref(view)
        return view


class LayerPool:
    """Buffers for the solutions alive together: the one being written, the newest, the one on the panels."""

    def __init__(self, stack: PanelStack) -> None:
        self._shape = stack.count, stack.height_px, stack.width_px, 4
        self._buffers: list[LayerBuffer] = []

    def take(self) -> LayerBuffer:
        """Return a free buffer with its last contents, else a new one."""
        for buffer in self._buffers:
            if buffer.holder() is None:
                return buffer
        buffer = LayerBuffer(np.full(self._shape, 255, np.uint8))
        self._buffers.append(buffer)
        return buffer
