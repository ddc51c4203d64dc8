"""Splats packed as SuperSplat and .splat have them, from the reference implementation's table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

CHUNK = 256
C0 = 0.28209479177387814


def columns(table: np.ndarray, *names: str) -> np.ndarray:
    return np.column_stack([table[name] for name in names]).astype(np.float64)


def unit_turns(table: np.ndarray) -> np.ndarray:
    """(n, 4) w, x, y, z."""
    turns = columns(table, "rot_0", "rot_1", "rot_2", "rot_3")
    return turns / np.linalg.norm(turns, axis=1, keepdims=True)


def colours(table: np.ndarray) -> np.ndarray:
    """(n, 4) RGBA, 0-1."""
    alpha = 1 / (1 + np.exp(-columns(table, "opacity")))
    return np.column_stack([0.5 + C0 * columns(table, "f_dc_0", "f_dc_1", "f_dc_2"), alpha])


def packed(share: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Fractions (n, k) as whole numbers side by side, the first in the highest bits."""
    word = np.zeros(len(share), np.uint64)
    for column, width in zip(share.T, bits, strict=True):
        word = (word << np.uint64(width)) | np.rint(np.clip(column, 0, 1) * (2**width - 1)).astype(np.uint64)
    return word.astype(np.uint32)


def element(name: str, held: dict[str, np.ndarray], kind: str) -> PlyElement:
    table = np.zeros(len(next(iter(held.values()))), [(field, kind) for field in held])
    for field, values in held.items():
        table[field] = values
    return PlyElement.describe(table, name)


def write_compressed(path: Path, table: np.ndarray, *, harmonics: bool = False) -> Path:
    """File in SuperSplat's format: 256 splats per chunk, bounds of places, scales and colours, harmonics of 8 bits."""
    count, rgba, turns = len(table), colours(table), unit_turns(table)
    bounds: dict[str, np.ndarray] = {}

    def share_of(held: np.ndarray, name: str, axes: str) -> np.ndarray:
        """Fractions between the bounds of each chunk, which are kept."""
        ends = []
        for end, reduce in (("min", np.min), ("max", np.max)):
            chunks = np.array([reduce(held[first : first + CHUNK], axis=0) for first in range(0, count, CHUNK)])
            bounds.update({f"{end}_{name}{axis}": chunks[:, k] for k, axis in enumerate(axes)})
            ends.append(np.repeat(chunks, CHUNK, axis=0)[:count])
        return (held - ends[0]) / np.maximum(ends[1] - ends[0], 1e-12)

    largest = np.abs(turns).argmax(1)
    turns *= np.sign(turns[np.arange(count), largest])[:, None]
    three = np.array([np.delete(turn, number) for turn, number in zip(turns, largest, strict=True)])
    vertex = {
        "packed_position": packed(share_of(columns(table, "x", "y", "z"), "", "xyz"), (11, 10, 11)),
        "packed_rotation": packed(np.column_stack([largest / 3, three / np.sqrt(2) + 0.5]), (2, 10, 10, 10)),
        "packed_scale": packed(
            share_of(columns(table, "scale_0", "scale_1", "scale_2"), "scale_", "xyz"), (11, 10, 11)
        ),
        "packed_color": packed(np.column_stack([share_of(rgba[:, :3], "", "rgb"), rgba[:, 3]]), (8, 8, 8, 8)),
    }
    elements = [element("chunk", bounds, "f4"), element("vertex", vertex, "u4")]
    if harmonics:
        rest = [name for name in table.dtype.names or () if name.startswith("f_rest")]
        elements.append(element("sh", {name: np.rint((table[name] + 4) * 255 / 8) for name in rest}, "u1"))
    PlyData(elements).write(path)
    return path


def write_splat(path: Path, table: np.ndarray) -> Path:
    """File in the web viewers' .splat format: 32 bytes per splat."""
    out = np.zeros(len(table), [("place", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("turn", "u1", 4)])
    out["place"] = columns(table, "x", "y", "z")
    out["scale"] = np.exp(columns(table, "scale_0", "scale_1", "scale_2"))
    out["colour"] = np.rint(255 * np.clip(colours(table), 0, 1))
    out["turn"] = np.clip(np.rint(unit_turns(table) * 128 + 128), 0, 255)
    path.write_bytes(out.tobytes())
    return path
