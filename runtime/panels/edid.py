"""Parse a monitor's EDID (the base block defined by VESA E-EDID 1.3 and 1.4)."""

from __future__ import annotations

import re
from dataclasses import dataclass

HEADER = b"\x00\xff\xff\xff\xff\xff\xff\x00"
BLOCK_BYTES = 128
DESCRIPTORS = (54, 72, 90, 108)
SERIAL_TAG, NAME_TAG = 0xFF, 0xFC


@dataclass(frozen=True, slots=True)
class Edid:
    """A monitor's identity, as given by its EDID."""

    maker: str  # the manufacturer's three-letter code
    serial: str  # serial number, unique only among monitors of the same model; empty if unknown
    name: str  # model name; empty if unknown


def parse(data: bytes) -> Edid | None:
    """Parse an EDID's base block, or return None if its length, header or checksum is wrong."""
    block = data[:BLOCK_BYTES]
    if len(block) < BLOCK_BYTES or not block.startswith(HEADER) or sum(block) % 256:
        return None
    letters = int.from_bytes(block[8:10], "big")
    maker = "".join(chr(64 + (letters >> shift & 31)) for shift in (10, 5, 0))
    number = int.from_bytes(block[12:16], "little")
    return Edid(
        maker=maker,
        # Manufacturers use 0 or 0x01010101 for monitors without a serial number.
        serial=_text(block, SERIAL_TAG) or (str(number) if number not in (0, 0x01010101) else ""),
        name=_text(block, NAME_TAG),
    )


def _text(block: bytes, tag: int) -> str:
    for start in DESCRIPTORS:
        descriptor = block[start : start + 18]
        if descriptor[:3] == b"\x00\x00\x00" and descriptor[3] == tag:
            # Ends with a line feed by the standard, and with zeros in many monitors.
            text = re.split(rb"[\n\0]", descriptor[5:])[0].decode("cp437")
            return "".join(filter(str.isprintable, text)).strip()
    return ""
