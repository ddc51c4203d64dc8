"""Read PLY headers, and read the elements in binary PLY files as structured arrays.

No existing library is suitable: plyfile is licensed under the GPL, and trimesh returns only the properties it knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.untrusted_input import LIMITS

Table = NDArray[Any]

LONGEST_HEADER = 65536
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PACKED = "packed_position"  # property that identifies SuperSplat's compressed splats
SPLAT_MARKS = {"f_dc_0", "scale_0", "rot_0", PACKED}


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """Description of the elements in a PLY file, as declared by its header."""

    path: Path
    order: str  # byte order of the elements, or `ascii`; a key of ORDERS
    counts: dict[str, int]  # number of elements of each kind, in the order they are stored in
    properties: dict[str, list[tuple[str, str]]]  # (name, type) of each kind's properties; a type may be `list`
    starts_at: int  # byte offset of the first element
    size: int  # file size in bytes

    @property
    def kind(self) -> str:
        """Kind of content (`splats` or `triangles`), which determines the limits for the file."""
        return "splats" if SPLAT_MARKS & {name for name, _ in self.properties["vertex"]} else "triangles"

    @property
    def is_packed(self) -> bool:
        """True if the file contains splats in SuperSplat's compressed form."""
        return PACKED in {name for name, _ in self.properties["vertex"]}


def read_header(path: Path) -> PlyHeader:
    """Read a PLY file's header. Raises InputError if it is missing, incomplete or exceeds a limit."""
    with untrusted_input.open_regular(path, most_bytes=LIMITS.file_bytes) as file:
        head = file.read(LONGEST_HEADER)
        size = file.seek(0, 2)
    text, mark, _ = head.partition(b"end_header")
    newline = head.find(b"\n", len(text))
    if not head.startswith(b"ply") or not mark or newline < 0:
        raise InputError(path, "header", "the PLY header is incomplete")
    order, counts, properties = "", dict[str, int](), dict[str, list[tuple[str, str]]]()
    for line in text.decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", name, _] if name in ORDERS:
                order = name
            case ["element", name, number]:
                field = f"element {untrusted_input.shown(name)}"
                counts[name] = untrusted_input.whole_from_text(number, source=path, field=field)
                fields = properties.setdefault(name, [])
            case ["property", "list", _, _, name] if properties:
                fields.append((name, "list"))
            case ["property", kind, name] if kind in TYPES and properties:
                fields.append((name, TYPES[kind]))
            case ["format" | "element" | "property", *_]:
                raise InputError(path, "header", f"this line is not valid PLY: {untrusted_input.shown(line.strip())}")
    twice = any(len({name for name, _ in fields}) < len(fields) for fields in properties.values())
    if not order or not properties.get("vertex") or twice:
        raise InputError(path, "vertex", "the header lacks a format or vertices, or declares a property twice")
    header = PlyHeader(path, order, counts, properties, newline + 1, size)
    for name, count in counts.items():
        field, kind = f"element {untrusted_input.shown(name)}", header.kind
        most = getattr(LIMITS, kind) * (3 if kind == "triangles" and name == "vertex" else 1)
        untrusted_input.within(count, most, source=path, field=field)
        if count > size:  # every element takes at least one byte
            raise InputError(
                path, field, f"the file is truncated; the header declares {count:,} elements in {size:,} bytes"
            )
    return header


def read_elements(header: PlyHeader) -> dict[str, Table]:
    """Read the elements in a binary PLY file as structured arrays, by name, up to the first that has a
    list property. Raises InputError.
    """
    path, place, found = header.path, header.starts_at, dict[str, Table]()
    if header.order == "ascii":
        raise InputError(
            path, "format", "is ascii, but splats can be read only from binary files; save the file as binary PLY"
        )
    with untrusted_input.open_regular(path) as file:
        for name, count in header.counts.items():
            if "list" in {kind for _, kind in header.properties[name]}:
                break
            dtype = np.dtype([(field, ORDERS[header.order] + kind) for field, kind in header.properties[name]])
            present = (header.size - place) // max(dtype.itemsize, 1)
            if present < count:
                problem = f"the file is truncated: only {max(present, 0)} of the {count} declared elements are present"
                raise InputError(path, untrusted_input.shown(name), problem)
            file.seek(place)
            found[name] = np.frombuffer(file.read(count * dtype.itemsize), dtype)
            place += count * dtype.itemsize
    if "vertex" not in found:
        raise InputError(
            path, "vertex", "must precede every element with lists, and each of its properties must be a single number"
        )
    return found
