"""A monitor's own account of itself (VESA E-EDID 1.3/1.4, base block)."""

from __future__ import annotations

from dataclasses import dataclass

HEADER = b"\x00\xff\xff\xff\xff\xff\xff\x00"
BLOCK_BYTES = 128
DESCRIPTORS = (54, 72, 90, 108)
SERIAL_TAG, NAME_TAG = 0xFF, 0xFC


@dataclass(frozen=True, slots=True)
class Edid:
    """Maker, model and serials of a monitor; a serial is empty if the maker gave none."""

    maker: str  # three letters
    serial: str  # the serial as text, or else the number of the header; unique only together with the model
    name: str


def parse(data: bytes) -> Edid | None:
    """The base block of an EDID; None where it is not one (length, header or checksum)."""
    block = data[:BLOCK_BYTES]
    if len(block) < BLOCK_BYTES or not block.startswith(HEADER) or sum(block) % 256:
        return None
    letters = int.from_bytes(block[8:10], "big")
    maker = "".join(chr(64 + (letters >> shift & 31)) for shift in (10, 5, 0))
    number = int.from_bytes(block[12:16], "little")
    return Edid(
        maker=maker,
        # 0 and 0x01010101 are what makers write who did not give a number.
        serial=_text(block, SERIAL_TAG) or (str(number) if number not in (0, 0x01010101) else ""),
        name=_text(block, NAME_TAG),
    )


def _text(block: bytes, tag: int) -> str:
    for start in DESCRIPTORS:
        descriptor = block[start : start + 18]
        if descriptor[:3] == b"\x00\x00\x00" and descriptor[3] == tag:
            return descriptor[5:18].split(b"\n")[0].decode("cp437").strip()
    return ""
