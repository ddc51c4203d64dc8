"""Find the second view in a Leia picture (LIF, from a Lume Pad), which is a JPEG followed by fields.

The file ends with the fields' total length and a marker. The number of fields comes before the fields themselves. Each
field consists of an identifier, a size and data. One field describes the views in JSON: it gives each view's position
and the identifier of the field that holds the view's JPEG. The identifier -1 denotes the JPEG at the start of the file.
"""

from __future__ import annotations

import struct
from typing import IO

from runtime.errors import InputError
from runtime.support.untrusted_input import parsed_json

MARK = b"\x1e\x1a"
VIEWS, OWN = 7, -1  # field identifiers for the JSON that describes the views, and for the JPEG at the start of the file
JSON_BYTES_MAX = 65536


def other_view(file: IO[bytes]) -> tuple[slice, bool] | None:
    """Return the second JPEG's byte range in a Leia picture, and if it is the left eye's, or None."""
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
        # If there are more than two views, use the outermost ones, because adjacent views are closer than two eyes.
        left, right = across[0][1], across[-1][1]
        return (fields[right], False) if left == OWN else (fields[left], True) if right == OWN else None
    except (InputError, LookupError, TypeError, ValueError):
        return None
