"""Reader for the second view of a Leia picture (LIF, from a Lume Pad), a JPEG followed by fields.

The file ends with the total length of the fields and a marker. The fields begin with their count; each has an
identifier, a size and its bytes. One field describes the views in JSON: the position of each and the field that
contains its JPEG, where -1 is the file itself.
"""

from __future__ import annotations

import struct
from typing import IO

from runtime.errors import InputError
from runtime.support.untrusted_input import parsed_json

MARK = b"\x1e\x1a"
VIEWS, OWN = 7, -1  # field identifiers: the views' JSON; the JPEG at the start of the file
JSON_BYTES_MAX = 65536


def other_view(file: IO[bytes]) -> tuple[slice, bool] | None:
    """Return the other JPEG of a pair and whether it is the left eye's, or None for other files."""
    size = file.seek(0, 2)
    if size < 6:
        return None
    file.seek(size - 6)
    length, mark = struct.unpack(">L2s", file.read(6))
    if mark != MARK or not 4 < length <= size:
        return None
    place, end, fields = size - length + 4, size - len(MARK) - 4, dict[int, slice]()
    while place + 8 <= end:
        file.seek(place)
        number, held = struct.unpack(">LL", file.read(8))
        fields[number] = slice(place + 8, place + 8 + held)
        place += 8 + held
    told = fields.get(VIEWS, slice(0, 0))
    if place != end or not 0 < told.stop - told.start <= JSON_BYTES_MAX:
        return None
    file.seek(told.start)
    try:
        views = parsed_json(file.read(told.stop - told.start), source="LIF")["views"]
        across = sorted((float(view["xLocation"]), int(view["albedoId"])) for view in views)
        # Of more than two views use the outermost, because neighbours are closer together than eyes.
        left, right = across[0][1], across[-1][1]
        return (fields[right], False) if left == OWN else (fields[left], True) if right == OWN else None
    except (InputError, LookupError, TypeError, ValueError):
        return None
