"""The vertices of a PLY file as a table: scalar properties only, which is all that splat files have."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import InputError

Table = NDArray[Any]

LONGEST_HEADER = 65536
MOST_VERTICES = 10_000_000  # with harmonics to degree 3 that is 2.4 GB
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class _Header:
    ascii: bool
    count: int  # of vertices
    dtype: np.dtype[Any]  # of one vertex
    starts_at: int  # bytes before the first vertex


def read_vertices(path: Path) -> Table:
    """A structured array with a field for each property. Raises InputError: no PLY, truncated, lists among them."""
    try:
        with path.open("rb") as file:
            head = file.read(LONGEST_HEADER)
        size = path.stat().st_size
    except OSError as error:
        raise InputError(path, "", f"cannot be read ({error.strerror})") from None
    header = _header(head, path)
    if header.ascii:
        return _from_text(path, header)
    held = (size - header.starts_at) // header.dtype.itemsize
    if held < header.count:
        raise InputError(path, "vertex", f"the file is cut off: {header.count} are promised and {max(held, 0)} there")
    return np.fromfile(path, header.dtype, header.count, offset=header.starts_at)


def _from_text(path: Path, header: _Header) -> Table:
    with path.open("rb") as file:
        file.seek(header.starts_at)
        try:
            values = np.loadtxt(file, dtype=np.float64, ndmin=2, max_rows=header.count, encoding="ascii")
        except ValueError as error:
            raise InputError(path, "vertex", f"malformed: {error}") from None
    wide = len(header.dtype.names or ())
    if values.shape != (header.count, wide):
        raise InputError(path, "vertex", f"{header.count} lines of {wide} numbers are promised, not {values.shape}")
    table = np.empty(header.count, header.dtype)
    for column, name in enumerate(header.dtype.names or ()):
        table[name] = values[:, column]
    return table


def _header(head: bytes, path: Path) -> _Header:
    text, mark, _ = head.partition(b"end_header")
    newline = head.find(b"\n", len(text))
    if not head.startswith(b"ply") or not mark or newline < 0:
        raise InputError(path, "header", "no whole PLY header")
    order, count = "", -1
    fields: list[tuple[str, str]] = []
    element = ""
    for line in text.decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", name, _] if name in ORDERS:
                order = name
            case ["element", name, number] if number.isdigit():
                if name == "vertex":
                    count = int(number)
                elif count < 0 and int(number):
                    raise InputError(path, f"element {name}", "stands before the vertices")
                element = name
            case ["property", kind, name] if kind in TYPES:
                if element == "vertex":
                    fields.append((name, ORDERS.get(order, "=") + TYPES[kind]))
            case ["property", "list", *_]:
                if element == "vertex":
                    raise InputError(path, words[-1], "is a list; each vertex must have one number")
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(path, "header", f"not understood: {line.strip()[:80]}")
    if not order or count < 0 or not fields:
        raise InputError(path, "vertex", "the header declares none")
    if len({name for name, _ in fields}) < len(fields):
        raise InputError(path, "vertex", "a property is declared twice")
    if count > MOST_VERTICES:
        raise InputError(path, "vertex", f"{count} are more than the {MOST_VERTICES} that can be drawn")
    return _Header(order == "ascii", count, np.dtype(fields), newline + 1)
