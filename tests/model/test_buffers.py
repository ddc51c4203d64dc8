"""Layers that somebody holds never change; a buffer that nobody holds is used again."""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.model.buffers import LayerPool, LayerSlots
from runtime.optics.stack import PanelStack
from runtime.records import U8

STACK = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 5, 4)


def written(pool: LayerPool, value: int) -> U8:
    buffer = pool.take()
    buffer.pixels[:] = value
    return buffer.handed_over()


@given(st.lists(st.sets(st.integers(0, 5)), max_size=30))
def test_held_layers_never_change_and_no_more_are_allocated_than_held(story: Any) -> None:
    """story: which of the layers that are held are let go before each next ones."""
    held: list[Any] = []
    pool, most = LayerPool(STACK), 0
    for value, letting_go in enumerate(story):
        held = [entry for index, entry in enumerate(held) if index not in letting_go]
        held.append((value % 256, written(pool, value % 256)))
        with pytest.raises(ValueError, match="read-only"):
            held[-1][1][:] = 0
        most = max(most, len(held))
        for expected, layers in held:
            assert (layers == expected).all()
        assert len(pool._buffers) <= most
        del layers


def test_a_part_of_them_holds_all_of_them() -> None:
    pool = LayerPool(STACK)
    part = written(pool, 1)[0, :2]
    written(pool, 2)
    written(pool, 3)
    assert (part == 1).all()


@pytest.fixture
def both() -> Iterator[tuple[LayerSlots, LayerSlots]]:
    """The same sixteen slots, for the solver and for the presenter."""
    file = os.memfd_create("layers")
    os.ftruncate(file, LayerSlots.bytes_of(STACK))
    yield LayerSlots(file, STACK), LayerSlots(file, STACK)
    os.close(file)


SHAPE = (3, 4, 5, 4)


def test_slots_are_pages_that_shared_memory_has_room_for() -> None:
    assert LayerSlots.bytes_of(STACK) == 17 * mmap.PAGESIZE
    page_px = mmap.PAGESIZE // 16
    for width_px, pages in ((page_px, 1 + 16 * 3), (page_px + 1, 1 + 16 * 4)):
        assert LayerSlots.bytes_of(PanelStack(0.5, 0.3, STACK.x_m, width_px, 4)) == pages * mmap.PAGESIZE


def test_the_solver_s_slots_are_free_again_once_the_presenter_lets_go(both: tuple[LayerSlots, LayerSlots]) -> None:
    ours, theirs = both
    held: list[Any] = []
    for value in range(16):
        assert ours.has_room()
        buffer = ours.take(SHAPE)
        assert buffer is not None and (buffer.pixels == 255).all()  # opaque white at first
        buffer.pixels[:] = value
        layers = buffer.handed_over()
        handed = ours.hand_over(layers)
        assert handed == (value, SHAPE)
        del layers
        held.append(theirs.view(*handed))
    assert not ours.has_room() and ours.take(SHAPE) is None and ours.hand_over(held[3].copy()) is None
    assert [int(view.max()) for view in held] == list(range(16)) == [int(view.min()) for view in held]
    with pytest.raises(ValueError, match="read-only"):
        held[0][:] = 1
    held[5] = None
    again = ours.take(SHAPE)
    assert ours.has_room() and again is not None and (again.pixels == 5).all()
    kept = again.handed_over()
    assert not ours.has_room()  # the solver itself has it
    del kept
    other = ours.take((3, 2, 5, 4))
    assert other is not None and (other.pixels == 255).all() and other.pixels.shape == (3, 2, 5, 4)


def test_layers_from_elsewhere_are_copied_into_a_slot(both: tuple[LayerSlots, LayerSlots]) -> None:
    ours, theirs = both
    layers = np.full(SHAPE, 7, np.uint8)
    first = LayerPool(STACK, ours).take()
    first.pixels[:], first.outside = 3, "known"
    assert ours.hand_over(layers) == (0, SHAPE) and first.outside is None
    assert (theirs.view(0, SHAPE) == 7).all()
    assert ours.hand_over(first.pixels[0, 1:]) == (1, (3, 5, 4))  # an inner part is no slot


def test_a_new_solver_gets_what_the_presenter_does_not_show(both: tuple[LayerSlots, LayerSlots]) -> None:
    ours, theirs = both
    for value in range(16):
        assert ours.hand_over(np.full(SHAPE, value, np.uint8)) == (value, SHAPE)
    shown = theirs.view(9, SHAPE)
    assert ours.take(SHAPE) is None and LayerPool(STACK, ours).take().pixels.shape == SHAPE  # memory of its own
    theirs.reclaim()
    free = [ours.hand_over(np.full(SHAPE, 99, np.uint8)) for _ in range(16)]
    assert [slot and slot[0] for slot in free] == [*range(9), *range(10, 16), None]
    assert (shown == 9).all()
