"""Writes splats in the formats of SuperSplat, .splat, SPZ and SOG."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import zstandard
from PIL import Image
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

    largest, three = smallest_three(turns)
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


def rest_of(table: np.ndarray) -> np.ndarray:
    """(n, k, 3) harmonics above degree 0."""
    rest = [name for name in table.dtype.names or () if name.startswith("f_rest")]
    return columns(table, *rest).reshape(len(table), 3, -1).transpose(0, 2, 1) if rest else np.zeros((len(table), 0, 3))


def smallest_three(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) which number of a turn is the largest, and (n, 3) the others, with its sign made positive."""
    largest = np.abs(turns).argmax(1)
    turns = turns * np.sign(turns[np.arange(len(turns)), largest])[:, None]
    return largest, np.array([np.delete(turn, number) for turn, number in zip(turns, largest, strict=True)])


def write_spz(path: Path, table: np.ndarray, *, version: int) -> Path:
    """File in Niantic's format: all splats' places, opacities, colours, scales, turns and harmonics."""
    count, rgba, rest = len(table), colours(table), rest_of(table)
    dc = columns(table, "f_dc_0", "f_dc_1", "f_dc_2")
    places, xyzw = columns(table, "x", "y", "z"), np.roll(unit_turns(table), -1, axis=1)
    fixed = np.rint(places * 4096).astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3]
    if version < 3:
        turns = np.rint((xyzw[:, :3] * np.sign(xyzw[:, 3:]) + 1) * 127.5).astype(np.uint8)
    else:
        largest, three = smallest_three(xyzw)
        shares = np.column_stack([largest / 3, *(part for v in three.T for part in (v < 0, np.abs(v) * np.sqrt(2)))])
        turns = packed(shares, (2, 1, 9, 1, 9, 1, 9))
    blocks = [
        (places.astype("<f2") if version == 1 else fixed).tobytes(),
        np.rint(255 * rgba[:, 3]).astype(np.uint8).tobytes(),
        np.clip(np.rint((dc * 0.15 + 0.5) * 255), 0, 255).astype(np.uint8).tobytes(),
        np.rint((columns(table, "scale_0", "scale_1", "scale_2") + 10) * 16).astype(np.uint8).tobytes(),
        turns.tobytes(),
        np.clip(np.rint(rest * 128 + 128), 0, 255).astype(np.uint8).tobytes(),
    ]
    degree = round((rest.shape[1] + 1) ** 0.5) - 1
    streams = [zstandard.compress(block) for block in blocks if block]
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, len(streams) if version == 4 else 0)
    if version < 4:
        path.write_bytes(gzip.compress(head + b"".join(blocks)))
    else:
        sizes = zip(streams, filter(None, blocks), strict=True)
        toc = b"".join(struct.pack("<QQ", len(stream), len(block)) for stream, block in sizes)
        path.write_bytes(head + struct.pack("<I12x", 32) + toc + b"".join(streams))
    return path


def write_sog(path: Path, table: np.ndarray) -> Path:
    """PlayCanvas version 2: pictures of bytes, with a palette of one entry a splat. A folder without a suffix."""
    count, rgba, rest, held = len(table), colours(table), rest_of(table), dict[str, bytes]()

    def picture(name: str, rows: np.ndarray, width: int) -> list[str]:
        codes = np.full((-(-len(rows) // width) * width, 4), 255, np.uint8)
        codes[: len(rows), : rows.shape[1]] = rows
        file = io.BytesIO()
        Image.fromarray(codes.reshape(-1, width, 4)).save(file, "WEBP", lossless=True, exact=True)
        held[f"{name}.webp"] = file.getvalue()
        return [f"{name}.webp"]

    def coded(values: np.ndarray) -> tuple[list[float], np.ndarray]:
        """A codebook of 256 numbers, and the nearest of them."""
        book = np.linspace(values.min(), values.max(), 256)
        return book.tolist(), np.rint((values - book[0]) / (book[1] - book[0]))

    places = columns(table, "x", "y", "z")
    logs = np.sign(places) * np.log1p(np.abs(places))
    low, high = logs.min(0), logs.max(0)
    words = np.rint((logs - low) / (high - low) * 65535).astype(int)
    largest, three = smallest_three(unit_turns(table))
    turns = np.column_stack([np.rint((three * np.sqrt(2) + 1) * 127.5), largest + 252])
    scales, flat = (
        coded(columns(table, "scale_0", "scale_1", "scale_2")),
        coded(columns(table, "f_dc_0", "f_dc_1", "f_dc_2")),
    )
    means = picture("means_l", words % 256, 16) + picture("means_u", words // 256, 16)
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": means},
        "scales": {"codebook": scales[0], "files": picture("scales", scales[1], 16)},
        "quats": {"files": picture("quats", turns, 16)},
        "sh0": {
            "codebook": flat[0],
            "files": picture("sh0", np.column_stack([flat[1], np.rint(255 * rgba[:, 3])]), 16),
        },
    }
    if bands := round((rest.shape[1] + 1) ** 0.5) - 1:
        book, entries = coded(rest)
        labels = np.arange(count)
        files = picture("shN_centroids", entries.reshape(-1, 3), 64 * rest.shape[1])
        files += picture("shN_labels", np.column_stack([labels % 256, labels // 256]), 16)
        meta["shN"] = {"count": count, "bands": bands, "codebook": book, "files": files}
    held["meta.json"] = json.dumps(meta).encode()
    if path.suffix:
        with zipfile.ZipFile(path, "w") as file:
            for name, data in held.items():
                file.writestr(name, data)
    else:
        path.mkdir()
        for name, data in held.items():
            (path / name).write_bytes(data)
    return path
