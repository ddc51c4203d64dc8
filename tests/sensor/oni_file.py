"""Writes a small uncompressed `.oni` recording, so that the real OpenNI2 library has something to play.

The layout follows what OpenNI2's own recorder writes: records of a 28-byte header (magic, kind, node, length of the
fields, length of the payload, position of the record before), fields and payload.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

INT, GENERAL, NODE_REMOVED, DATA_BEGIN, STATE_READY, NEW_DATA, END, NODE_ADDED, INDEX = 3, 6, 7, 8, 9, 10, 11, 13, 14
REAL = 4
DEPTH_NODE, IMAGE_NODE = 1, 2
DEPTH_1_MM, RGB888 = 100, 200


class _File:
    def __init__(self) -> None:
        self.data = bytearray(b"NI10" + struct.pack("<BBHIQI", 1, 0, 1, 0, 2**64 - 1, 2))

    def record(self, kind: int, node: int, fields: bytes = b"", payload: bytes = b"", undo: int = 0) -> int:
        at = len(self.data)
        self.data += struct.pack("<4sIIIIQ", b"NIR\0", kind, node, 28 + len(fields), len(payload), undo)
        self.data += fields + payload
        return at

    def number(self, node: int, name: str, value: int) -> None:
        self.record(INT, node, _named(name) + struct.pack("<Iq", 8, value))

    def real(self, node: int, name: str, value: float) -> None:
        self.record(REAL, node, _named(name) + struct.pack("<Id", 8, value))

    def general(self, node: int, name: str, value: bytes) -> None:
        self.record(GENERAL, node, _named(name) + struct.pack("<I", len(value)) + value)


def _named(name: str) -> bytes:
    return struct.pack("<I", len(name) + 1) + name.encode() + b"\0"


def write_oni(
    path: Path, depth: np.ndarray, colour: np.ndarray, *, rate_hz: int = 30, fov_rad: tuple[float, float] | None = None
) -> None:
    """depth: (n, h, w) uint16 mm; colour: (n, h, w, 3) uint8 RGB, of the same size; fov: horizontal and vertical."""
    count, height, width = depth.shape
    file = _File()
    nodes = ((DEPTH_NODE, "Depth", 2, DEPTH_1_MM, depth), (IMAGE_NODE, "Image", 3, RGB888, colour))
    added = {}
    mode = struct.pack("<III", width, height, rate_hz)
    stamps = [k * 1_000_000 // rate_hz for k in range(count)]
    for node, name, kind, pixels, frames in nodes:
        fields = _named(name) + struct.pack("<I4sIQQQ", kind, b"NONE", count, 0, stamps[-1], 0)
        added[node] = file.record(NODE_ADDED, node, fields)
        file.number(node, "oniRequiredFrameSize", frames[0].nbytes)
        file.number(node, "xnIsGenerating", 1)
        if node == DEPTH_NODE:
            file.number(node, "xnDeviceMaxDepth", 65535)
        if fov_rad is not None:
            file.general(node, "xnFOV", struct.pack("<dd", *fov_rad))
        file.number(node, "xnSupportedMapOutputModesCount", 1)
        file.general(node, "xnSupportedMapOutputModes", mode)
        file.general(node, "xnMapOutputMode", mode)
        file.general(node, "xnCropping", struct.pack("<iHHHH", 0, 0, 0, width, height))
        file.general(node, "xnSupportedPixelFormats", struct.pack("<I", 8 if node == DEPTH_NODE else 1))
        file.number(node, "xnPixelFormat", 4 if node == DEPTH_NODE else 1)
        file.number(node, "oniPixelFormat", pixels)
    for node in (DEPTH_NODE, IMAGE_NODE):
        file.record(STATE_READY, node)
        file.record(DATA_BEGIN, node, struct.pack("<IQ", count, stamps[-1]))
    places: dict[int, list[int]] = {DEPTH_NODE: [], IMAGE_NODE: []}
    for k, stamp in enumerate(stamps):
        for node, _, _, _, frames in nodes:
            before = places[node][-1] if places[node] else 0
            payload = np.ascontiguousarray(frames[k]).tobytes()
            places[node].append(file.record(NEW_DATA, node, struct.pack("<QI", stamp, k + 1), payload, before))
    for node, name, *_ in nodes:
        file.record(NODE_REMOVED, node, undo=added[node])
        index = b"".join(struct.pack("<QIQ", s, 0, p) for s, p in zip([0, *stamps], [0, *places[node]]))
        at = file.record(INDEX, node, payload=index)
        seek_field = added[node] + 28 + len(_named(name)) + struct.calcsize("<I4sIQQ")
        struct.pack_into("<Q", file.data, seek_field, at)
    file.record(END, 0)
    path.write_bytes(bytes(file.data))
