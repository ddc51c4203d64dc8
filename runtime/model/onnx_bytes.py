"""Facts of an ONNX file from its bytes alone: its producer, and references to other files.

Protocol buffers are rows of (tag, value); field numbers are those of onnx.proto.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

MODEL_GRAPH, MODEL_METADATA, MODEL_FUNCTIONS = 7, 14, 25
GRAPH_NODE, GRAPH_INITIALIZER, GRAPH_SPARSE = 1, 5, 15
FUNCTION_NODE = 7
NODE_ATTRIBUTE = 5
ATTRIBUTE_TENSORS, ATTRIBUTE_GRAPHS, ATTRIBUTE_SPARSE = (5, 10), (6, 11), (22, 23)
SPARSE_PARTS = (1, 2)
TENSOR_EXTERNAL, TENSOR_LOCATION = 13, 14
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
DEEPEST = 32  # graphs within attributes of graphs


def fields(data: memoryview) -> Iterator[tuple[int, memoryview, memoryview]]:
    """(number, value, the whole field) of a message, in order; a number's value is empty if it is 0.

    Raises ValueError for bytes that are no such message.
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
            raise ValueError("is not a protocol buffer")
        if end > len(data):
            raise ValueError("ends too early")
        yield tag >> 3, value, data[begin:end]
        at = end


def digest(data: bytes) -> str:
    """SHA-256 of a model without its metadata, which holds the digest. Raises ValueError."""
    found = hashlib.sha256()
    for number, _, whole in fields(memoryview(data)):
        if number != MODEL_METADATA:
            found.update(whole)
    return found.hexdigest()


def has_external_data(data: bytes) -> bool:
    """Return True if a tensor of the model is stored in another file. Raises ValueError."""
    for number, value, _ in fields(memoryview(data)):
        if number == MODEL_GRAPH and _graph(value, DEEPEST):
            return True
        if number == MODEL_FUNCTIONS:
            nodes = (part for field, part, _ in fields(value) if field == FUNCTION_NODE)
            if any(_node(node, DEEPEST) for node in nodes):
                return True
    return False


def _graph(data: memoryview, depth: int) -> bool:
    if not depth:
        raise ValueError("nests too deep")
    for number, value, _ in fields(data):
        if number == GRAPH_NODE and _node(value, depth):
            return True
        if (number == GRAPH_INITIALIZER and _tensor(value)) or (number == GRAPH_SPARSE and _sparse(value)):
            return True
    return False


def _node(data: memoryview, depth: int) -> bool:
    for number, attribute, _ in fields(data):
        if number != NODE_ATTRIBUTE:
            continue
        for field, value, _ in fields(attribute):
            if (
                (field in ATTRIBUTE_TENSORS and _tensor(value))
                or (field in ATTRIBUTE_SPARSE and _sparse(value))
                or (field in ATTRIBUTE_GRAPHS and _graph(value, depth - 1))
            ):
                return True
    return False


def _sparse(data: memoryview) -> bool:
    return any(_tensor(value) for number, value, _ in fields(data) if number in SPARSE_PARTS)


def _tensor(data: memoryview) -> bool:
    return any(
        number == TENSOR_EXTERNAL or (number == TENSOR_LOCATION and bytes(value) == b"\x01")
        for number, value, _ in fields(data)
    )


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("is not a protocol buffer")
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
