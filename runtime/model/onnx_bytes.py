"""Compute an ONNX file's digest and find references to other files, without loading the model.

The file is a protocol buffer, which is a sequence of tags and values. Field numbers are defined in onnx.proto.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

MODEL_METADATA = 14
# For each message type, the fields that can lead to a tensor, with the type of message they contain.
PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse tensor"},
    "function": {7: "node"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 10: "tensor", 6: "graph", 11: "graph", 22: "sparse tensor", 23: "sparse tensor"},
    "sparse tensor": {1: "tensor", 2: "tensor"},
}
TENSOR_EXTERNAL, TENSOR_LOCATION = 13, 14
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
DEEPEST = 32  # maximum nesting depth of graphs within graph attributes


def fields(data: memoryview) -> Iterator[tuple[int, memoryview, memoryview]]:
    """Yield the number, the value (empty for an integer 0) and the full bytes of each field in a message.
    Raises ValueError if the bytes are not a message.
    """
    at = 0
    while at < len(data):
        begin = at
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == VARINT:
            number, end = _varint(data, at)
            value = data[at:end] if number else data[:0]
        elif kind in (FIXED64, FIXED32):
            end = at + (8 if kind == FIXED64 else 4)
            value = data[at:end]
        elif kind == BYTES:
            length, at = _varint(data, at)
            end = at + length
            value = data[at:end]
        else:
            raise ValueError("is not a valid protocol buffer")
        if end > len(data):
            raise ValueError("is truncated")
        yield tag >> 3, value, data[begin:end]
        at = end


def digest(data: bytes) -> str:
    """Return a model's SHA-256, excluding its metadata. Raises ValueError if the model is malformed."""
    digester = hashlib.sha256()
    for number, _, whole in fields(memoryview(data)):
        if number != MODEL_METADATA:
            digester.update(whole)
    return digester.hexdigest()


def has_external_data(data: bytes) -> bool:
    """Return True if a model stores a tensor in another file. Raises ValueError if it is malformed."""
    return _refers_to_a_file("model", memoryview(data), DEEPEST)


def _refers_to_a_file(message: str, data: memoryview, depth: int) -> bool:
    if message == "tensor":
        return any(
            number == TENSOR_EXTERNAL or (number == TENSOR_LOCATION and bytes(value) == b"\x01")
            for number, value, _ in fields(data)
        )
    if not depth:
        raise ValueError("is nested too deeply")
    parts = PARTS[message]
    within = ((parts[number], value) for number, value, _ in fields(data) if number in parts)
    return any(
        _refers_to_a_file(part, value, depth - (message == "attribute" and part == "graph")) for part, value in within
    )


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("is not a valid protocol buffer")
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
