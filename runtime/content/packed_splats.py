"""Read Gaussian splats from SuperSplat's compressed .ply files and from .splat files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from runtime.content.gaussians import COEFFICIENTS, Gaussians, drawable, flat_harmonics, with_higher
from runtime.content.ply import PlyHeader, read_elements
from runtime.errors import InputError
from runtime.records import F32
from runtime.support import untrusted_input
from runtime.support.untrusted_input import LIMITS

CHUNK = 256  # number of consecutive splats that share bounds
SPLAT = np.dtype([("place", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("turn", "u1", 4)])
U32 = NDArray[np.uint32]


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
