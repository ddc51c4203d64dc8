"""Protocol buffers, byte by byte."""

from __future__ import annotations

import pytest

from runtime.model.onnx_bytes import digest, fields, has_external_data


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", []),
        (b"\x08\x00", [(1, b"", b"\x08\x00")]),
        (b"\x08\x96\x01", [(1, b"\x96\x01", b"\x08\x96\x01")]),
        (b"\x82\x01\x02ab", [(16, b"ab", b"\x82\x01\x02ab")]),
        (b"\x0d1234\x11" + b"12345678", [(1, b"1234", b"\x0d1234"), (2, b"12345678", b"\x11" + b"12345678")]),
        (b"\x0a" + b"\x80\x01" + b"x" * 128, [(1, b"x" * 128, b"\x0a\x80\x01" + b"x" * 128)]),
        (b"\x08" + b"\xff" * 9 + b"\x01", [(1, b"\xff" * 9 + b"\x01", b"\x08" + b"\xff" * 9 + b"\x01")]),
    ],
)
def test_fields_have_a_number_a_value_and_their_bytes(data: bytes, found: list[tuple[int, bytes, bytes]]) -> None:
    assert [(number, bytes(value), bytes(whole)) for number, value, whole in fields(memoryview(data))] == found


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"\x08", "not a valid"),
        (b"\x80", "not a valid"),
        (b"\x08" + b"\xff" * 10 + b"\x01", "not a valid"),
        (b"\x0b", "not a valid"),
        (b"\x0a\x03ab", "truncated"),
        (b"\x0d123", "truncated"),
        (b"\x111234567", "truncated"),
    ],
)
def test_bytes_that_are_no_message_are_refused(data: bytes, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        list(fields(memoryview(data)))
    with pytest.raises(ValueError, match=problem):
        digest(data)


def inside(*numbers: int, value: bytes) -> bytes:
    """A value within messages, of which the first number is the outermost field."""
    for number in reversed(numbers):
        sizes = (number << 3 | 2, len(value))
        value = b"".join(bytes([n]) if n < 128 else bytes([n & 127 | 128, n >> 7]) for n in sizes) + value
    return value


EXTERNAL = b"\x70\x01"  # data_location: EXTERNAL


@pytest.mark.parametrize("tensor", [EXTERNAL, b"\x6a\x00", b"\x08\x01" + EXTERNAL])
@pytest.mark.parametrize(
    "way", [(7, 5), (7, 15, 1), (7, 15, 2), (7, 1, 5, 5), (7, 1, 5, 10), (7, 1, 5, 22, 1), (25, 7, 5, 23, 2)]
)
def test_a_tensor_in_another_file_is_found_on_every_way(way: tuple[int, ...], tensor: bytes) -> None:
    assert has_external_data(inside(*way, value=tensor))
    assert not has_external_data(inside(*way, value=b"\x70\x00"))
    assert not has_external_data(inside(8, *way[1:], value=tensor))


@pytest.mark.parametrize("graph", [6, 11])
def test_graphs_may_be_nested_thirty_one_times(graph: int) -> None:
    assert has_external_data(inside(7, *(1, 5, graph) * 31, 5, value=EXTERNAL))
    with pytest.raises(ValueError, match="nested too deeply"):
        has_external_data(inside(7, *(1, 5, graph) * 32, 5, value=EXTERNAL))
