"""Buffers for solutions: one is written anew only when nobody holds the layers that it carried."""

from __future__ import annotations

import weakref
from collections.abc import Callable

import numpy as np

from runtime.records import U8


class LayerBuffers:
    """As many buffers as are held at once, which is three: being written, newest, shown. One thread takes."""

    def __init__(self) -> None:
        self._buffers: list[tuple[U8, Callable[[], U8 | None]]] = []

    def copy_of(self, layers: U8) -> U8:
        """(...) the same values in a buffer that is nobody else's as long as the answer lives."""
        held = [holder() is not None for _, holder in self._buffers]
        index = held.index(False) if False in held else len(held)
        if index == len(held):
            self._buffers.append((np.empty(layers.shape, np.uint8), _nobody))
        buffer = self._buffers[index][0]
        np.copyto(buffer, layers)
        # Not `buffer.view()`: a part of that would hold the buffer, and not the view that is asked about.
        view: U8 = np.asarray(buffer.data.toreadonly())
        self._buffers[index] = buffer, weakref.ref(view)
        return view


def _nobody() -> None:
    return None
