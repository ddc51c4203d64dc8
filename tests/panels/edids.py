"""Builds EDID blocks by VESA's table 3.1."""

from __future__ import annotations

EIZO = 5 << 10 | 9 << 5 | 26  # letters count from A = 1


def block(*, serial_text: str = "", serial_number: int = 0, name: str = "CG2700X") -> bytes:
    def text(tag: int, value: str) -> bytes:
        return bytes([0, 0, 0, tag, 0]) + (value + "\n").encode().ljust(13)[:13]

    data = b"\x00\xff\xff\xff\xff\xff\xff\x00"
    data += EIZO.to_bytes(2, "big") + (0x2B7A).to_bytes(2, "little") + serial_number.to_bytes(4, "little")
    data += bytes([10, 33, 1, 4]) + bytes(54 - 20)
    data += bytes(18)  # a detailed timing is not text
    data += text(0xFF, serial_text) if serial_text else bytes(18)
    data += text(0xFC, name) + bytes(18) + b"\x00"
    return data + bytes([-sum(data) % 256])
