"""Layers that somebody holds never change; a buffer that nobody holds is used again."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.model.buffers import LayerPool
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
