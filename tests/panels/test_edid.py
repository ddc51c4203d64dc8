"""Tests that a monitor is identified by its EDID."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.panels.edid import parse
from tests.panels.edids import block


@pytest.mark.parametrize("serial", ["A1B2-0003", "0123456789ABC"])
def test_maker_model_and_serial_are_read_from_any_descriptor(serial: str) -> None:
    data = block(serial_text=serial)
    for start in (54, 72, 90, 108):
        edid = parse(data[:54] + data[start:126] + data[54:start] + data[126:])
        assert (edid.maker, edid.name, edid.serial) == ("EIZ", "CG2700X", serial)


def test_a_serial_number_is_text_unless_it_means_none() -> None:
    numbers = (1234, 0, 0x01010101)
    assert [parse(block(serial_number=number)).serial for number in numbers] == ["1234", "", ""]


def test_text_padded_with_zeros_ends_at_the_first() -> None:
    edid = parse(block(serial_text="H9JW901197\0\0", name="C27R50x\0"))
    assert (edid.name, edid.serial) == ("C27R50x", "H9JW901197")


def test_control_characters_are_not_part_of_a_name() -> None:
    assert parse(block(serial_text="A\x1b[1", name="\0\0")).serial == "A[1"


@given(st.binary(max_size=300))
def test_noise_is_no_edid(data: Any) -> None:
    assert parse(data) is None


@given(st.integers(0, 127), st.integers(1, 255))
def test_one_wrong_byte_is_noticed(position: Any, change: Any) -> None:
    data = bytearray(block(serial_text="X"))
    data[position] = (data[position] + change) % 256
    assert parse(bytes(data)) is None
