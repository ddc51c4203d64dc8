"""Read compressed Gaussian splats: SuperSplat's .ply, .splat, SPZ (version 1 to 4), SOG (version 2)."""

from __future__ import annotations

import io
import itertools
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from runtime.content.gaussians import COEFFICIENTS, Gaussians, drawable, flat_harmonics, with_higher
from runtime.content.ply import PlyHeader, read_elements
from runtime.errors import InputError
from runtime.records import F32, U8
from runtime.support import untrusted_input
from runtime.support.picture_header import decoded_picture
from runtime.support.untrusted_input import LIMITS

SPZ_HEADER = struct.Struct("<4sIIBBBBI12x")  # magic, version, count, degree, position bits, flags, streams, table
SPZ_SHORT = 16  # header size in bytes before version 4
SPZ_COLOUR = 0.15  # scale of SPZ colours relative to degree-0 coefficients
SOG_PARTS = {"means": 2, "scales": 1, "quats": 1, "sh0": 1}  # number of pictures that store each property
FIRST_TAG = 252  # alpha if a rotation's largest component is number 0; 253 to 255 stand for 1 to 3
WIDE = 64  # palette entries per row of `shN_centroids`
MOST = max(COEFFICIENTS) // 3  # largest number of coefficients above degree 0 per channel; degree 4 is not drawn
CHUNK = 256  # number of consecutive splats that share bounds in SuperSplat's files
SPLAT = np.dtype([("place", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("turn", "u1", 4)])
U32 = NDArray[np.uint32]


def is_sog_folder(folder: Path) -> bool:
    """Return True if a folder contains an unpacked SOG file."""
    return (folder / "meta.json").is_file() and (folder / "means_l.webp").is_file()


def load_compressed_splats(path: Path) -> Gaussians:
    """Read an SPZ file, a SOG file, or a folder with an unpacked SOG file. Raises InputError."""
    if path.suffix.lower() != ".spz":
        with _damage_is(path, "is damaged or is not a SOG file"):
            return _sog(path)
    with _damage_is(path, "is damaged or is not an SPZ file"):
        return _spz(path, untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes))


def spz_splats(path: Path, data: bytes) -> Gaussians:
    """Read splats from SPZ data that are part of the file `path`. Raises InputError if they are damaged."""
    with _damage_is(path, "contains damaged SPZ data"):
        return _spz(path, data)


@contextmanager
def _damage_is(path: Path, problem: str) -> Iterator[None]:
    """Raise InputError for the various errors of zlib, zipfile, zstandard and malformed JSON."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (InputError, ImportError, MemoryError):
        raise
    except Exception:
        raise InputError(path, "", problem) from None


def _spz(path: Path, data: bytes) -> Gaussians:
    """Read SPZ data: the positions of all splats, then all opacities, colours, scales, rotations and harmonics."""
    zipped = zlib.decompressobj(31) if data[:2] == b"\x1f\x8b" else None
    head = zipped.decompress(data, SPZ_SHORT) if zipped else data[: SPZ_HEADER.size]
    mark, version, count, degree, bits, _, _, table = SPZ_HEADER.unpack(head.ljust(SPZ_HEADER.size, b"\0"))
    if mark != b"NGSP" or not 1 <= version <= 4 or degree > 4:
        raise InputError(path, "", "is not an SPZ file of version 1 to 4")
    untrusted_input.within(count, LIMITS.splats, source=path, field="splats")
    rest = (degree + 1) ** 2 - 1
    sizes = [count * each for each in (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * rest)]
    if version < 4:
        body = zipped.decompress(zipped.unconsumed_tail, sum(sizes) or 1) if zipped else data[SPZ_SHORT:]
        ends = np.cumsum([0, *sizes])
        blocks = [body[first:end] for first, end in itertools.pairwise(ends)]
    else:
        blocks = _zstd_blocks(data, table, sizes)
    if [len(block) for block in blocks] != sizes:
        raise InputError(path, "", f"is truncated; the header declares {count:,} splats")
    places, alphas, colours, scales, turns, higher = (np.frombuffer(block, np.uint8) for block in blocks)
    flat = np.asarray((colours.reshape(count, 1, 3) / np.float32(255) - np.float32(0.5)) / SPZ_COLOUR, np.float32)
    return drawable(
        path,
        centres=places.view("<f2").reshape(count, 3).astype(np.float32) if version == 1 else _fixed(places, bits),
        log_scales=np.asarray(scales.reshape(count, 3) / 16 - 10, np.float32),
        quaternions=_three_bytes(turns.reshape(count, 3)) if version < 3 else _four_bytes(turns.view("<u4")),
        logits=logit(alphas / np.float32(255)),
        harmonics=with_higher(flat, higher.reshape(count, rest, 3)[:, :MOST], zero=128, unit=1 / 128),
    )


def _zstd_blocks(data: bytes, table: int, sizes: list[int]) -> list[bytes]:
    """Decompress a version 4 SPZ file's streams, listed in a `table` at a byte offset, up to the expected sizes in
    bytes. Empty streams may be missing from the file.
    """
    import zstandard

    names = [size for size in sizes if size]
    place, blocks = table + 16 * len(names), []
    for number, size in enumerate(names):
        packed, _ = struct.unpack_from("<QQ", data, table + 16 * number)
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data[place : place + packed]) as stream:
            blocks.append(stream.read(size))
        place += packed
    return [blocks.pop(0) if size else b"" for size in sizes]


def _fixed(places: U8, bits: int) -> F32:
    """Decode positions (n, 3) from signed 24-bit fixed-point numbers with `bits` fractional bits."""
    low, middle, high = places.reshape(-1, 3, 3).astype(np.int32).transpose(2, 0, 1)
    return np.asarray(((high << 24 | middle << 16 | low << 8) >> 8) * 2.0**-bits, np.float32)


def _three_bytes(turns: U8) -> F32:
    """Decode the x, y and z bytes (n, 3) of quaternions into quaternions (n, 4) in w, x, y, z order."""
    xyz = turns / np.float32(127.5) - 1
    return np.column_stack([np.sqrt(np.maximum(1 - (xyz**2).sum(1), 0)), xyz]).astype(np.float32)


def _four_bytes(turns: U32) -> F32:
    """Decode packed 32-bit words (n,) into quaternions (n, 4), w, x, y, z. The top two bits are the index of the
    largest component, in x, y, z, w order. The other three follow, each with a sign bit and a 9-bit magnitude.
    """
    share = fields_of(turns, (1, 9, 1, 9, 1, 9))
    three = (1 - 2 * share[:, ::2]) * share[:, 1::2] * np.float32(np.sqrt(0.5))
    return np.roll(with_largest(three, turns >> 30), 1, axis=1)


def _sog(path: Path) -> Gaussians:
    """Read a SOG file or folder: pictures of a pixel per splat, in fractions of a range or codebook indices."""
    with _SogFiles(path) as files:
        meta = untrusted_input.parsed_json(files.read("meta.json"), source=path)
        if meta.get("version") != 2:
            version = untrusted_input.shown(meta.get("version", 1))
            raise InputError(path, "meta.json", f"has SOG version {version}, but only version 2 is supported")
        count = int(meta["count"])
        untrusted_input.within(count, LIMITS.splats, source=path, field="splats")
        low, high, scales, turns, flat = (
            files.pixels(name, count) for part, number in SOG_PARTS.items() for name in meta[part]["files"][:number]
        )
        ends = (np.array(meta["means"][end], np.float32) for end in ("mins", "maxs"))
        share = (high[:, :3].astype(np.float32) * 256 + low[:, :3]) / 65535
        first, last = ends
        logs = first + (last - first) * share
        harmonics = np.array(meta["sh0"]["codebook"], np.float32)[flat[:, :3]][:, None]
        if more := meta.get("shN"):
            palette = files.picture(more["files"][0])
            entries = palette[..., :3].reshape(-1, palette.shape[1] // WIDE, 3)
            label = files.pixels(more["files"][1], count)[:, :2].astype(np.int64) @ [1, 256]
            higher = np.array(more["codebook"], np.float32)[entries[label]]
            harmonics = with_higher(harmonics, higher[:, :MOST])
    if 3 * (harmonics.shape[1] - 1) not in COEFFICIENTS:
        raise InputError(path, "shN", "does not contain harmonics of degree 1 to 3")
    three = (turns[:, :3] / np.float32(255) - np.float32(0.5)) * np.float32(np.sqrt(2))
    return drawable(
        path,
        centres=np.sign(logs) * np.expm1(np.abs(logs)),
        log_scales=np.array(meta["scales"]["codebook"], np.float32)[scales[:, :3]],
        quaternions=with_largest(three, turns[:, 3].astype(np.uint32) - FIRST_TAG),
        logits=logit(flat[:, 3] / np.float32(255)),
        harmonics=harmonics,
    )


class _SogFiles:
    """Reader for the pictures and metadata of a SOG scene, stored in a folder or a ZIP archive."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._zip = (
            None
            if path.is_dir()
            else zipfile.ZipFile(io.BytesIO(untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)))
        )

    def __enter__(self) -> _SogFiles:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def read(self, name: str) -> bytes:
        if self._zip is None:
            return untrusted_input.read_bytes(self._path / Path(name).name, most_bytes=LIMITS.file_bytes)
        untrusted_input.within(self._zip.getinfo(name).file_size, LIMITS.file_bytes, source=self._path, field=name)
        return self._zip.read(name)

    def picture(self, name: str) -> U8:
        """Return a picture as an RGBA array (h, w, 4). Raises InputError if the picture cannot be decoded."""
        image = decoded_picture(self.read(name), source=self._path, field=untrusted_input.shown(name), name="")
        return np.asarray(image.convert("RGBA"))

    def pixels(self, name: str, count: int) -> U8:
        """Return a picture's first `count` pixels (count, 4). Raises InputError if it has fewer."""
        pixels = self.picture(name).reshape(-1, 4)[:count]
        if len(pixels) < count:
            raise InputError(self._path, untrusted_input.shown(name), f"has only {len(pixels)} of the {count} pixels")
        return pixels


@np.errstate(all="ignore")
def load_compressed(header: PlyHeader) -> Gaussians:
    """Read a PLY file compressed by SuperSplat: 8- to 11-bit fractions of the bounds of a chunk of
    splats. Raises InputError if it is damaged, bounds or harmonics are missing for some splats, or no splat is visible.
    """
    elements = read_elements(header)
    splats, bounds = elements["vertex"], elements.get("chunk")
    names = {*(splats.dtype.names or ())}
    kinds = ("position", "rotation", "scale", "color")
    if bounds is None or len(bounds) * CHUNK < len(splats) or not {f"packed_{kind}" for kind in kinds} <= names:
        raise InputError(header.path, "chunk", "is missing or lacks bounds for some splats")
    place, turn, scale, colour = (splats[f"packed_{kind}"].astype(np.uint32) for kind in kinds)

    def bounds_of(name: str, axes: str) -> list[F32]:
        """Return two (n, 3) arrays: the lower and the upper bounds of each splat's chunk."""
        columns = [[f"{end}_{name}{axis}" for axis in axes] for end in ("min", "max")]
        if missing := {*columns[0], *columns[1]} - {*(bounds.dtype.names or ())}:
            raise InputError(header.path, "chunk", f"has no {min(missing)}")
        of = np.arange(len(splats)) // CHUNK
        return [np.column_stack([bounds[column] for column in wanted])[of] for wanted in columns]

    rgba = fields_of(colour, (8, 8, 8, 8))
    if "min_r" in (bounds.dtype.names or ()):
        rgba[:, :3] = _between(rgba[:, :3], *bounds_of("", "rgb"))
    harmonics = flat_harmonics(rgba[:, :3])
    if fields := elements["sh"].dtype.names if "sh" in elements else ():
        rest = np.column_stack([elements["sh"][name] for name in fields])
        if rest.shape[1] not in COEFFICIENTS or len(rest) != len(splats):
            raise InputError(header.path, "sh", "does not contain harmonics of degree 1 to 3 for every splat")
        higher = rest.reshape(len(rest), 3, -1).transpose(0, 2, 1)
        harmonics = with_higher(harmonics, higher, zero=127.5, unit=8 / 255)
    return drawable(
        header.path,
        centres=_between(fields_of(place, (11, 10, 11)), *bounds_of("", "xyz")),
        log_scales=_between(fields_of(scale, (11, 10, 11)), *bounds_of("scale_", "xyz")),
        quaternions=_turns(turn),
        logits=logit(rgba[:, 3]),
        harmonics=harmonics,
    )


@np.errstate(all="ignore")
def load_splat(path: Path) -> Gaussians:
    """Read a .splat file: position, scale, RGBA colour and rotation in 32 bytes per splat. Raises
    InputError if its size is not a positive multiple of 32 bytes, or no splat is visible.
    """
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    if not data or len(data) % SPLAT.itemsize:
        problem = (
            f"is truncated or is not a .splat: its size must be a multiple of {SPLAT.itemsize}, not {len(data)} bytes"
        )
        raise InputError(path, "", problem)
    table = np.frombuffer(data, SPLAT)
    untrusted_input.within(len(table), LIMITS.splats, source=path, field="splats")
    rgba = np.asarray(table["colour"], np.float32) / np.float32(255)
    return drawable(
        path,
        centres=table["place"],
        log_scales=np.log(table["scale"]),
        quaternions=np.asarray(table["turn"], np.float32) / np.float32(128) - np.float32(1),
        logits=logit(rgba[:, 3]),
        harmonics=flat_harmonics(rgba[:, :3]),
    )


def fields_of(packed: U32, bits: tuple[int, ...]) -> F32:
    """Unpack bit fields, highest first, of words (n,) to fractions of their maxima (n, len(bits))."""
    parts = []
    for width in reversed(bits):
        most = (1 << width) - 1
        parts.append((packed & most) / most)
        packed = packed >> np.uint32(width)
    return np.column_stack(parts[::-1]).astype(np.float32)


def _between(share: F32, low: F32, high: F32) -> F32:
    return np.asarray(low * (1 - share) + high * share, np.float32)


def _turns(packed: U32) -> F32:
    """Decode words (n,) into quaternions (n, 4), w, x, y, z; the top two bits name the missing component."""
    return with_largest((fields_of(packed, (10, 10, 10)) - np.float32(0.5)) * np.float32(np.sqrt(2)), packed >> 30)


def with_largest(three: NDArray[np.floating[Any]], number: NDArray[np.integer[Any]]) -> F32:
    """Return unit quaternions (n, 4) from three components each (n, 3), and the index (n,) of the
    missing, largest one. If an index is above 3, the quaternion is zero.
    """
    largest = np.sqrt(np.maximum(1 - (three**2).sum(1), 0))
    quaternions = np.zeros((len(three), 4), np.float32)
    for place in range(4):
        rows = number == place
        quaternions[rows] = np.insert(three[rows], place, largest[rows], axis=1)
    return quaternions
