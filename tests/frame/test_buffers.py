"""Layers that somebody holds never change; a buffer that nobody holds is used again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.frame.solver import LayerBuffers

SHAPE = (3, 4, 5, 4)


def layers(value: int) -> np.ndarray:
    return np.full(SHAPE, value, np.uint8)


@given(st.lists(st.sets(st.integers(0, 5)), max_size=30))
def test_held_buffers_never_change_and_no_more_are_made_than_held(story: Any) -> None:
    """story: which of the copies that are held are let go before each next one."""
    held: list[Any] = []
    buffers, most = LayerBuffers(), 0
    for value, letting_go in enumerate(story):
        held = [entry for index, entry in enumerate(held) if index not in letting_go]
        held.append((value % 256, buffers.copy_of(layers(value % 256))))
        with pytest.raises(ValueError, match="read-only"):
            held[-1][1][:] = 0
        most = max(most, len(held))
        for expected, copy in held:
            assert (copy == expected).all()
        assert len(buffers._buffers) <= most
        del copy


def test_a_part_of_it_holds_all_of_it() -> None:
    buffers = LayerBuffers()
    part = buffers.copy_of(layers(1))[0, :2]
    buffers.copy_of(layers(2))
    buffers.copy_of(layers(3))
    assert (part == 1).all()
