"""Writes glTF files with arrays in one buffer."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CODES = {"float32": 5126, "int16": 5122, "uint16": 5123, "int8": 5120, "uint8": 5121, "uint32": 5125}


class Buffer:
    """Arrays in one buffer, an accessor each."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: Any, dtype: Any = np.float32, **more: Any) -> int:
        """(n, w) numbers; answers the accessor's index. more: of the accessor's table."""
        array = np.ascontiguousarray(np.asarray(values, dtype=dtype).reshape(len(values), -1))
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes()
        kind = {"componentType": CODES[array.dtype.name], "type": KINDS[array.shape[1]]}
        self.accessors.append({"bufferView": len(self.views) - 1, "count": len(array), **kind, **more})
        return len(self.accessors) - 1

    def table(self, primitive: dict[str, Any], **tables: Any) -> dict[str, Any]:
        """Document of one node with one mesh; `tables` override its parts."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        return {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "buffers": [{"uri": uri, "byteLength": len(self.data)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
            **tables,
        }

    def write(self, path: Path, primitive: dict[str, Any], **tables: Any) -> Path:
        path.write_text(json.dumps(self.table(primitive, **tables)))
        return path


SQUARE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
SQUARE_FACES = [0, 1, 2, 0, 2, 3]
