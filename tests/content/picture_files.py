"""Writes picture files in the way of cameras, phones and browsers."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import cv2
import numpy as np
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


def swapped_profile() -> bytes:
    """sRGB's profile with red and green exchanged: its effect is obvious."""
    from PIL import ImageCms

    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    count = int.from_bytes(data[128:132], "big")
    rows = {bytes(data[at : at + 4]): at + 4 for at in range(132, 132 + 12 * count, 12)}
    red, green = rows[b"rXYZ"], rows[b"gXYZ"]
    data[red : red + 4], data[green : green + 4] = data[green : green + 4], data[red : red + 4]
    return bytes(data)


def lif(path: Path, own: U8, other: U8, *, own_is_left: bool = True) -> Path:
    """A JPEG with the fields of a Leia picture behind it, one of them the other view's JPEG."""
    jpegs = []
    for picture in (own, other):
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=95, subsampling=0)
        jpegs.append(file.getvalue())
    places = (0.0, 1.0) if own_is_left else (1.0, 0.0)
    views = [{"albedoId": number, "xLocation": place} for number, place in zip((-1, 1000001), places, strict=True)]
    held = [(0, b"\0\0\0\4"), (1000001, jpegs[1]), (7, json.dumps({"views": views}).encode())]
    fields = b"".join(struct.pack(">LL", number, len(content)) + content for number, content in held)
    path.write_bytes(
        jpegs[0] + struct.pack(">L", len(held)) + fields + struct.pack(">L", len(fields) + 10) + b"\x1e\x1a"
    )
    return path


def of_colours(coded: bytes, *, primaries: int, transfer: int) -> bytes:
    """An AVIF or HEIC that states other colours."""
    at = coded.index(b"colrnclx") + 8
    return coded[:at] + struct.pack(">HH", primaries, transfer) + coded[at + 4 :]


def make_video(
    path: Path, colours: list[tuple[int, int, int]], size: tuple[int, int] = (160, 96), codec: str = "MJPG"
) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10, size)
    for colour in colours:
        writer.write(np.full((size[1], size[0], 3), colour[::-1], np.uint8))
    writer.release()
    return path


SAMPLES = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v")  # boxes around a film's description


def film(path: Path, frame: U8, *, added: bytes = b"", mode: int = 0, into: tuple[bytes, ...] = SAMPLES) -> Path:
    """Three equal frames; with boxes added to one of an MP4's boxes, or a Matroska's StereoMode."""
    height, width = frame.shape[:2]
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*("MJPG" if path.suffix == ".mkv" else "mp4v")), 10, (width, height)
    )
    for _ in range(3):
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    data = bytearray(path.read_bytes())
    if mode:
        at = data.index(b"\x54\xb2\x81")  # DisplayUnit has the same length
        data[at : at + 4] = bytes((0x53, 0xB8, 0x81, mode))
    end = 0
    for kind in into if added else ():
        at = data.index(kind, end and data.index(b"moov")) - 4
        size = int.from_bytes(data[at : at + 4], "big")
        data[at : at + 4] = (size + len(added)).to_bytes(4, "big")
        end = at + size
    data[end:end] = added
    path.write_bytes(data)
    return path


def st3d(mode: int) -> bytes:
    return _box(b"st3d", bytes(4) + bytes([mode]))


def equirectangular() -> bytes:
    proj = _box(b"proj", _box(b"prhd", bytes(16)) + _box(b"equi", bytes(20)))
    return _box(b"sv3d", _box(b"svhd", bytes(4) + b"me\0") + proj)


def spherical_xml(layout: str) -> bytes:
    """The form before `sv3d`: XML in a track's `uuid` box (Spherical Video V1 RFC)."""
    fields = {
        "Spherical": "true",
        "Stitched": "true",
        "StitchingSoftware": "me",
        "ProjectionType": "equirectangular",
        "StereoMode": layout,
    }
    text = "".join(f"<GSpherical:{name}>{value}</GSpherical:{name}>" for name, value in fields.items())
    xml = f'<?xml version="1.0"?><rdf:SphericalVideo xmlns:GSpherical="x">{text}</rdf:SphericalVideo>'
    return _box(b"uuid", bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + xml.encode())


def multiview() -> bytes:
    """What a film of a headset states: both eyes."""
    return _box(b"vexu", _box(b"eyes", _box(b"stri", bytes(4) + b"\x03")))
