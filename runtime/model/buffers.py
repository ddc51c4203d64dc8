"""Pool of layer buffers, so that solutions can be written in place instead of being copied."""

from __future__ import annotations

import mmap
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from math import prod

import numpy as np

from runtime.optics.stack import PanelStack
from runtime.records import U8

SLOTS = 16  # solutions in shared memory: the one being computed, the newest, those on the panels or being measured
FREE, HANDED_OVER = 0, 1


@dataclass(eq=False)
class LayerBuffer:
    """Memory for one solution's layers."""

    pixels: U8  # (N, h, w, 4) RGBA, opaque
    outside: object = None  # key for the contents outside the solved boxes; None: unknown
    holder: Callable[[], U8 | None] = field(default=lambda: None)  # returns the view in use, or None

    def handed_over(self) -> U8:
        """Return a read-only view of the layers. The buffer becomes free when the view is garbage-collected."""
        view = _read_only(self.pixels)
        self.holder = weakref.ref(view)
        return view


def _read_only(pixels: U8) -> U8:
    # A slice of `pixels.view()` would keep `pixels` alive, but not the view watched by the weak reference.
    view: U8 = np.asarray(pixels.data.toreadonly())
    return view


class LayerSlots:
    """Layers in memory that a solver's process shares with the presenter's.

    A slot is free for the solver until the solver hands it over by `hand_over`. From then on only the presenter reads
    it, and the solver does not write to it until the presenter has no view of it any more. So a solution that was being
    written when the solver was killed is in a slot that was never handed over.
    """

    def __init__(self, descriptor: int, stack: PanelStack) -> None:
        """Map the shared memory with `bytes_of(stack)` bytes that a file descriptor refers to."""
        memory = np.frombuffer(mmap.mmap(descriptor, self.bytes_of(stack)), np.uint8)
        self._states, self._memory = memory[: mmap.PAGESIZE], memory[mmap.PAGESIZE :].reshape(SLOTS, -1)
        self._begun = self._memory.ctypes.data
        self._users: dict[int, LayerBuffer] = {}  # the latest buffer in each slot; for the solver's process
        self._views: dict[int, weakref.ref[U8]] = {}  # views in use, by slot; for the presenter's process

    @staticmethod
    def bytes_of(stack: PanelStack) -> int:
        """Return how much address space is needed. Memory is used only for slots that have been written to."""
        return mmap.PAGESIZE + SLOTS * _room(stack.count * stack.height_px * stack.width_px * 4)

    # For the solver's process:

    def take(self, shape: tuple[int, ...]) -> LayerBuffer | None:
        """Return a free slot or None. It contains an earlier solution of the same shape, or opaque white."""
        free = [index for index in range(SLOTS) if self._is_free(index)]
        users = self._users
        alike = [index for index in free if index in users and users[index].pixels.shape == shape]
        if alike:
            return users[alike[0]]
        unused = [index for index in free if index not in users]
        if not free:
            return None
        index = (unused or free)[0]
        pixels = self._memory[index, : prod(shape)].reshape(shape)
        pixels[:] = 255
        users[index] = LayerBuffer(pixels)
        return users[index]

    def hand_over(self, layers: U8) -> tuple[int, tuple[int, ...]] | None:
        """Hand layers over to the presenter; return their slot and shape, or None if none is free."""
        index, offset = divmod(layers.ctypes.data - self._begun, self._memory.shape[1])
        if offset or not 0 <= index < SLOTS:
            buffer = self.take(layers.shape)
            if buffer is None:
                return None
            buffer.pixels[:], buffer.outside = layers, None
            index = (buffer.pixels.ctypes.data - self._begun) // self._memory.shape[1]
        self._states[index] = HANDED_OVER
        return index, layers.shape

    def has_room(self) -> bool:
        """Return True if a slot is free."""
        return any(map(self._is_free, range(SLOTS)))

    def _is_free(self, index: int) -> bool:
        user = self._users.get(index)
        return self._states[index] == FREE and (user is None or user.holder() is None)

    # For the presenter's process:

    def view(self, index: int, shape: tuple[int, ...]) -> U8:
        """Return a read-only view of layers that were handed over. Their slot is free once the view is gone."""
        view = _read_only(self._memory[index, : prod(shape)].reshape(shape))

        def release(_: weakref.ref[U8]) -> None:
            self._views.pop(index, None)
            self._states[index] = FREE

        self._views[index] = weakref.ref(view, release)
        return view

    def reclaim(self) -> None:
        """Free all slots that are not in use here, after the solver that took them has ended."""
        for index in range(SLOTS):
            if index not in self._views:
                self._states[index] = FREE


def _room(size: int) -> int:
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE


class LayerPool:
    """Buffers for all solutions in use: the one being computed, the newest, and the one on the panels."""

    def __init__(self, stack: PanelStack, slots: LayerSlots | None = None) -> None:
        """Create an empty pool for solutions on the stack's raster, in shared memory if there are slots."""
        self._shape, self._slots = (stack.count, stack.height_px, stack.width_px, 4), slots
        self._buffers: list[LayerBuffer] = []

    def take(self) -> LayerBuffer:
        """Return a free buffer with its previous contents, or a new one if all are in use."""
        shared = None if self._slots is None else self._slots.take(self._shape)
        if shared is not None:
            return shared
        for buffer in self._buffers:
            if buffer.holder() is None:
                return buffer
        buffer = LayerBuffer(np.full(self._shape, 255, np.uint8))
        self._buffers.append(buffer)
        return buffer
