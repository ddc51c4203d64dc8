"""Picture files as cameras, phones and browsers write them, made here."""

from __future__ import annotations

import io
import struct
from pathlib import Path

from PIL import Image

from runtime.records import U8

DISPARITY, UNDEFINED, THUMBNAIL = 0x020002, 0x000000, 0x010001  # of an MPO's second picture
PRIMARY = 0x030000


def mpo(path: Path, first: U8, second: U8, *, kind: int = DISPARITY, note: bytes = b"") -> Path:
    """Two pictures in one JPEG. note: of an APP1 segment in the second one."""
    file = io.BytesIO()
    Image.fromarray(first).save(
        file, "MPO", save_all=True, append_images=[Image.fromarray(second)], quality=95, subsampling=0
    )
    data = file.getvalue()
    index = data.index(b"MPF\0")
    entries = data.rindex(struct.pack("<L", PRIMARY), index, index + 102)
    data = data[: entries + 16] + struct.pack("<L", kind) + data[entries + 20 :]
    if note:
        start = data.index(b"\xff\xd8\xff", 3) + 2  # behind the second picture's beginning
        data = data[:start] + b"\xff\xe1" + struct.pack(">H", len(note) + 2) + note + data[start:]
    path.write_bytes(data)
    return path


def heic_pair(path: Path, pictures: list[U8], *, group: tuple[int, ...]) -> Path:
    """A HEIC of several pictures with a stereo pair group ('ster') of those at these places, left and right."""
    import pillow_heif

    made, file = pillow_heif.HeifFile(), io.BytesIO()
    for picture in pictures:
        made.add_from_pillow(Image.fromarray(picture))
    made.save(file, quality=90)
    data = file.getvalue()
    items = [int.from_bytes(entry[4:6], "big") for entry in data.split(b"infe")[1:]]
    entities = b"".join(struct.pack(">L", items[place]) for place in group)
    if not group:
        path.write_bytes(data)
        return path
    ster = _box(b"ster", struct.pack(">LLL", 0, 1000, len(group)) + entities)
    grpl = _box(b"grpl", ster)
    meta = data.index(b"meta") - 4
    end = meta + int.from_bytes(data[meta : meta + 4], "big")
    head = struct.pack(">L", end - meta + len(grpl)) + _shifted(data[meta + 4 : end], by=len(grpl))
    path.write_bytes(data[:meta] + head + grpl + data[end:])
    return path


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">L", len(content) + 8) + kind + content


def _shifted(meta: bytes, *, by: int) -> bytes:
    """A meta box whose places in the file (iloc, version 0, with a base of four bytes) are offset."""
    at = meta.index(b"iloc") + 4
    assert meta[at] == 0 and meta[at + 4 : at + 6] == b"\x44\x40"
    count, place, out = int.from_bytes(meta[at + 6 : at + 8], "big"), at + 8, bytearray(meta)
    for _ in range(count):
        out[place + 4 : place + 8] = (int.from_bytes(meta[place + 4 : place + 8], "big") + by).to_bytes(4, "big")
        place += 10 + 8 * int.from_bytes(meta[place + 8 : place + 10], "big")
    return bytes(out)


def profiled(path: Path, codes: U8, profile: bytes) -> Path:
    Image.fromarray(codes).save(path, icc_profile=profile)
    return path


def swapped_profile() -> bytes:
    """sRGB's profile with red and green exchanged: its effect is obvious."""
    from PIL import ImageCms

    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    count = int.from_bytes(data[128:132], "big")
    rows = {bytes(data[at : at + 4]): at + 4 for at in range(132, 132 + 12 * count, 12)}
    red, green = rows[b"rXYZ"], rows[b"gXYZ"]
    data[red : red + 4], data[green : green + 4] = data[green : green + 4], data[red : red + 4]
    return bytes(data)
