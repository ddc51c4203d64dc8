"""glTF files written by hand: one buffer, what the tests say of nodes, skins and animations."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CODES = {"float32": 5126, "uint16": 5123, "uint8": 5121, "uint32": 5125}


class Buffer:
    """Arrays in one buffer, an accessor each."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: Any, dtype: Any = np.float32) -> int:
        """(n, w) numbers; answers the accessor's index."""
        array = np.ascontiguousarray(np.asarray(values, dtype=dtype).reshape(len(values), -1))
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes()
        kind = {"componentType": CODES[array.dtype.name], "type": KINDS[array.shape[1]]}
        self.accessors.append({"bufferView": len(self.views) - 1, "count": len(array), **kind})
        return len(self.accessors) - 1

    def table(self, primitive: dict[str, Any], **tables: Any) -> dict[str, Any]:
        """Of one mesh that one node has, unless `tables` say otherwise."""
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


def moving_square(path: Path, *, kind: str = "LINEAR") -> Path:
    """A square that goes from x = -3 to x = 3 in two seconds."""
    b = Buffer()
    primitive = {"attributes": {"POSITION": b.add(SQUARE)}, "indices": b.add(SQUARE_FACES, np.uint16)}
    keys = [[-3, 0, 0], [3, 0, 0]]
    if kind == "CUBICSPLINE":
        keys = [[0, 0, 0], [-3, 0, 0], [0, 0, 0], [0, 0, 0], [3, 0, 0], [0, 0, 0]]
    sampler = {"input": b.add([0.0, 2.0]), "output": b.add(keys), "interpolation": kind}
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    return b.write(path, primitive, animations=[{"name": "slide", "samplers": [sampler], "channels": [channel]}])


def bending_bar(path: Path) -> Path:
    """A bar along y from 0 to 4, of two bones; the upper one turns by 90 degrees about z in a second."""
    b = Buffer()
    heights = np.arange(0, 4.01, 0.5)
    points = np.array([[x, y, 0.0] for y in heights for x in (-0.3, 0.3)])
    faces = [[i, i + 1, i + 2, i + 1, i + 3, i + 2] for i in range(0, len(points) - 2, 2)]
    upper = np.clip(points[:, 1] - 1.5, 0, 1)
    weights = np.column_stack([1 - upper, upper, np.zeros((len(points), 2))])
    joints = np.tile([0, 1, 0, 0], (len(points), 1))
    down = np.eye(4)
    down[1, 3] = -2.0
    attributes = {
        "POSITION": b.add(points),
        "JOINTS_0": b.add(joints, np.uint8),
        "WEIGHTS_0": b.add(weights),
    }
    primitive = {"attributes": attributes, "indices": b.add(np.concatenate(faces), np.uint16)}
    bound = b.add([np.eye(4).T.ravel(), down.T.ravel()])
    half = np.sqrt(0.5)
    sampler = {"input": b.add([0.0, 1.0]), "output": b.add([[0, 0, 0, 1], [0, 0, half, half]])}
    return b.write(
        path,
        primitive,
        scenes=[{"nodes": [0, 1]}],
        nodes=[
            {"mesh": 0, "skin": 0, "translation": [50, 50, 50]},  # which a skin leaves out
            {"children": [2]},
            {"translation": [0, 2, 0]},
        ],
        skins=[{"joints": [1, 2], "inverseBindMatrices": bound}],
        animations=[{"samplers": [sampler], "channels": [{"sampler": 0, "target": {"node": 2, "path": "rotation"}}]}],
    )
