"""The vertices of a PLY file as a table: scalar properties only, which is all that splats and point clouds have."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from runtime.config import LimitSettings
from runtime.errors import InputError, one_line
from runtime.support import foreign, progress

Table = NDArray[Any]

LONGEST_HEADER = 65536
LONGEST_LINE = 1 << 16
ROWS_AT_ONCE = 1 << 16
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_FACES = re.compile(rb"element (?:face|tristrips)\s+0*[1-9]")
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class _Header:
    ascii: bool
    count: int  # of vertices
    dtype: np.dtype[Any]  # of one vertex
    starts_at: int  # bytes before the first vertex


def check_counts(path: Path, data: bytes, *, limits: LimitSettings) -> None:
    """The counts that a mesh's header promises, against the limits and the file's size. Raises InputError.

    data: the whole file. A loader takes memory for what is promised.
    """
    text, mark, _ = data[:LONGEST_HEADER].partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise InputError(path, "header", "no whole PLY header")
    held = len(data) - len(text)
    for line in text.decode("latin-1").splitlines():
        words = line.split()
        if words[:1] != ["element"]:
            continue
        if len(words) != 3:
            raise InputError(path, "header", f"not understood: {foreign.shown(line)}")
        name, field = words[1], f"element {foreign.shown(words[1])}"
        count = foreign.whole_from_text(words[2], least=0, most=1 << 62, source=path, field=field)
        most = 3 * limits.triangles if name == "vertex" else limits.triangles
        named = "3 for each of limits.triangles" if name == "vertex" else "limits.triangles"
        foreign.within(count, most, source=path, field=field, limit=named)
        if count > held:  # the shortest has a byte
            raise InputError(path, field, f"the file is cut off: {count:,} are promised in {held:,} bytes")


def holds_points_alone(path: Path) -> bool:
    """True where a PLY's header has vertices and no faces. Raises InputError where it can't be read."""
    with foreign.open_regular(path) as file:
        head = file.read(LONGEST_HEADER).partition(b"end_header")[0]
    return head.startswith(b"ply") and b"element vertex" in head and not _FACES.search(head)


def read_vertices(
    path: Path, *, limits: LimitSettings | None = None, kind: Literal["splats", "points"] = "splats"
) -> Table:
    """A structured array with a field for each property. Raises InputError: no PLY, truncated, lists among them.

    kind: what the vertices are, which says how many there may be.
    """
    limits = limits or LimitSettings()
    with foreign.open_regular(path, most_bytes=round(limits.file_mib * foreign.MIB)) as file:
        head = file.read(LONGEST_HEADER)
        size = file.seek(0, 2)
        header = _header(head, path, limits, kind)
        if not header.ascii:
            held = (size - header.starts_at) // header.dtype.itemsize
            if held < header.count:
                problem = f"the file is cut off: {header.count} are promised and {max(held, 0)} there"
                raise InputError(path, "vertex", problem)
        elif header.count > size:
            raise InputError(path, "vertex", f"the file is cut off: {header.count} lines are promised in {size} bytes")
        file.seek(header.starts_at)
        table = np.empty(header.count, header.dtype)
        fill = _from_text if header.ascii else _from_bytes
        for start in range(0, header.count, ROWS_AT_ONCE):
            progress.tell(f"{path.name}: {kind}", start, header.count)
            fill(table[start : start + ROWS_AT_ONCE], file, path, start)
    return table


def _from_bytes(rows: Table, file: IO[bytes], path: Path, start: int) -> None:
    data = file.read(rows.nbytes)
    if len(data) < rows.nbytes:
        raise InputError(path, "vertex", f"the file is cut off within {start + len(rows)}")
    rows[:] = np.frombuffer(data, rows.dtype)


def _from_text(rows: Table, file: IO[bytes], path: Path, start: int) -> None:
    names = rows.dtype.names or ()
    lines = [file.readline(LONGEST_LINE) for _ in range(len(rows))]
    try:
        values = np.loadtxt(lines, dtype=np.float64, ndmin=2, encoding="ascii")
    except ValueError as error:
        raise InputError(path, "vertex", f"malformed after line {start}: {one_line(str(error), most=120)}") from None
    if values.shape != (len(rows), len(names)):
        problem = f"{len(rows)} lines of {len(names)} numbers are promised after {start}, not {values.shape}"
        raise InputError(path, "vertex", problem)
    for column, name in enumerate(names):
        rows[name] = values[:, column]


def _header(head: bytes, path: Path, limits: LimitSettings, what: Literal["splats", "points"]) -> _Header:
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
            case ["element", name, number]:
                field = f"element {foreign.shown(name)}"
                promised = foreign.whole_from_text(number, least=0, most=1 << 62, source=path, field=field)
                if name == "vertex":
                    count = promised
                elif count < 0 and promised:
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
                raise InputError(path, "header", f"not understood: {foreign.shown(line.strip())}")
    if not order or count < 0 or not fields:
        raise InputError(path, "vertex", "the header declares none")
    if len({name for name, _ in fields}) < len(fields):
        raise InputError(path, "vertex", "a property is declared twice")
    foreign.within(count, getattr(limits, what), source=path, field="vertex", limit=f"limits.{what}")
    return _Header(order == "ascii", count, np.dtype(fields), newline + 1)
