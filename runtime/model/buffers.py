"""Pool of layer buffers, so that solutions can be written in place instead of being copied."""

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
    outside: object = None  # key for the contents outside the solved boxes; None: unknown
    holder: Callable[[], U8 | None] = field(default=lambda: None)  # returns the view in use, or None if there is none

    def handed_over(self) -> U8:
        """Return a read-only view of the layers. The buffer becomes free when the view is garbage-collected."""
        # A slice of `pixels.view()` would keep `pixels` alive, but not the view watched by the weak reference.
        view: U8 = np.asarray(self.pixels.data.toreadonly())
        self.holder = weakref.ref(view)
        return view


class LayerPool:
    """Buffers for all solutions in use: the one being computed, the newest, and the one on the panels."""

    def __init__(self, stack: PanelStack) -> None:
        self._shape = stack.count, stack.height_px, stack.width_px, 4
        self._buffers: list[LayerBuffer] = []

    def take(self) -> LayerBuffer:
        """Return a free buffer with its previous contents, or a new one if all are in use."""
        for buffer in self._buffers:
            if buffer.holder() is None:
                return buffer
        buffer = LayerBuffer(np.full(self._shape, 255, np.uint8))
        self._buffers.append(buffer)
        return buffer
