"""Headers of picture files, which are read and checked against the limits before decoding."""

from __future__ import annotations

import importlib.util
import io
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any

from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.leia import other_view
from runtime.support.untrusted_input import LIMITS

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
PNG_DEPTH = slice(24, 25)  # position of a PNG's bit depth
CHUNK_BYTES = 12  # overhead of a PNG chunk: length, kind, checksum
SIDE_MAX_PX = 1 << 16  # maximum side that a header may declare
# Pillow's names. EPS is excluded, because Pillow would start Ghostscript. Pillow identifies an MPO as JPEG.
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "TGA", "AVIF")
ANIMATED = ("GIF", "PNG", "WEBP", "AVIF")
ORIENTATION = 0x0112  # EXIF tag
TURNED = (5, 6, 7, 8)  # quarter turns, which exchange width and height
MP_ENTRIES, MP_NUMBER = 0xB002, 0xB101  # tags of an MPO: its pictures; a picture's viewpoint, counted from the left
DISPARITY, UNDEFINED = "Multi-Frame Image: (Disparity)", "Undefined"
JPS, JPS_BYTES = b"_JPSJPS_", 14  # marker of a stereo header, and offset of its layout field
JPS_LAYOUTS = {2: "side-by-side", 3: "top-bottom", 4: "anaglyph"}
JPS_HALF_HEIGHT, JPS_HALF_WIDTH, JPS_LEFT_FIRST = 1, 2, 4
GAIN_MAP = (b"hdrgm", b"21496-1")  # markers of a gain map, a second picture that contains only brightness
HEAD_BYTES = 512  # number of bytes read to identify a file
UNDECODED = "cannot be decoded as an image"
ANOTHER = "save it as PNG, JPEG or AVIF"
CAMERA_SET = "train the scene first and open its splats (.ply), or open its folder of pictures as a slideshow"
RAW = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")  # most are also TIFFs
RAW_KIND = "a camera's raw picture", "develop it and save it as JPEG"
OTHER_KINDS = (  # unsupported formats: offset and value of the marker, name, remedy
    (0, b"\xff\x0a", "JPEG XL", f"{ANOTHER}, for example with `djxl in.jxl out.png`"),
    (4, b"JXL \r\n", "JPEG XL", f"{ANOTHER}, for example with `djxl in.jxl out.png`"),
    (0, b"v/1\x01", "OpenEXR", "tone-map the picture and save it as PNG"),
    (0, b"#?RADIANCE", "Radiance HDR", "tone-map the picture and save it as PNG"),
    (4, b"jP  \r\n", "JPEG 2000", ANOTHER),
    (0, b"8BPS", "a Photoshop document", ANOTHER),
    (0, b"%PDF", "PDF", "convert its pages to pictures with `pdftoppm -png`"),
    (0, b"%!PS", "PostScript", ANOTHER),
    (0, b"DDS ", "a texture (DDS)", ANOTHER),
    (1, b"KTX ", "a texture (KTX)", ANOTHER),
    (8, b"CR", *RAW_KIND),
    (0, b"FUJIFILMCCD-RAW", *RAW_KIND),
    (0, b"PK\3\4", "a ZIP archive", "unpack it first"),
    (0, b"7z\xbc\xaf", "a 7z archive", "unpack it first"),
    (0, b"Rar!", "a RAR archive", "unpack it first"),
    (0, b"\x89MCAP", "a recording", "play it with --replay"),
    (0, b"version https://git-lfs", "a Git LFS pointer", "fetch the file itself with `git lfs pull`"),
    (0, b"<svg", "SVG", ANOTHER),
    (0, b"<!DOCTYPE html", "a web page", "download the picture itself"),
    (0, b"<!doctype html", "a web page", "download the picture itself"),
)


@dataclass(frozen=True, slots=True)
class Header:
    """Properties of a picture file that are known without decoding it."""

    kind: str  # Pillow's name for the format
    width_px: int
    height_px: int
    views: tuple[int, ...]  # indices of the frames: the one to show, or the left and the right eye's
    is_animated: bool
    is_around: bool = False  # True if its XMP declares a sphere of 360 by 180 degrees
    warning: str = ""  # such as a missing second view
    layout: str = ""  # arrangement of the views in one picture, from its stereo header
    other: slice | None = None  # bytes of a Leia picture's other view


@contextmanager
def opened(coded: bytes | IO[bytes]) -> Iterator[Any]:
    """Open a picture with Pillow without decoding it.

    Pillow's own limits are off, because the caller applies stricter ones. Raises any exception of Pillow's formats.
    """
    from PIL import Image

    file = io.BytesIO(coded) if isinstance(coded, bytes) else coded
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        most, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            with Image.open(file, formats=_formats()) as image:
                yield image
        finally:
            Image.MAX_IMAGE_PIXELS = most


@cache
def _formats() -> tuple[str, ...]:
    """Return the names of supported Pillow formats, with HEIC if the extra `heic` is installed."""
    if importlib.util.find_spec("pillow_heif") is None:
        return FORMATS
    import pillow_heif

    pillow_heif.register_heif_opener(thumbnails=False, decode_threads=1)
    return (*FORMATS, "HEIF")


def _header_of(path: Path, coded: bytes | IO[bytes]) -> Header:
    """Return the header of a picture, read from its bytes or the open file.

    If an MPO does not declare its second picture as a view, it counts as one only in a file named .mpo.
    Raises InputError for a camera's raw picture, and for one that cannot be decoded or exceeds the size limit.
    """
    if path.suffix.lower() in RAW:  # of a TIFF, Pillow would show the thumbnail
        raise InputError(path, "", "is {}, which is not supported; {}".format(*RAW_KIND))
    try:
        with opened(coded) as image:
            width, height = image.size
            if _orientation(image) in TURNED:
                width, height = height, width
            is_animated = image.format in ANIMATED and bool(getattr(image, "is_animated", False))
            views, warning = _views(image, is_named_so=path.suffix.lower() == ".mpo")
            is_around, layout, other = b"equirectangular" in _xmp(image), _jps_layout(image), None
            if image.format == "JPEG" and (found := _leia_view(coded, image.size)):
                other, views = found[0], (1, 0) if found[1] else (0, 1)
            kind = image.format
        head = _beginning(coded, HEAD_BYTES)
    except Exception as error:  # each of Pillow's formats raises its own
        raise InputError(path, "", undecodable(_beginning(coded, LIMITS.file_bytes), error)) from None
    check_size(width, height, source=path, head=head)
    return Header(kind, width, height, views, is_animated, is_around, warning, layout, other)


def _beginning(coded: bytes | IO[bytes], most_bytes: int) -> bytes:
    if isinstance(coded, bytes):
        return coded[:most_bytes]
    coded.seek(0)
    return coded.read(most_bytes)


def _views(image: Any, *, is_named_so: bool) -> tuple[tuple[int, ...], str]:
    """Return the indices of the frames for the left and right eye, or of the only one, and a warning.

    A second picture is an eye's view only if the file declares it as one and if it is as large as the first.
    """
    shown = (image.tell(),)
    if image.format == "HEIF":
        for group in image.info.get("entity_groups", ()):
            left, right = (*group["images"], None, None)[:2]
            if group["type"] == "ster" and left is not None and right is not None:
                return ((left, right), "") if _size_of(image, left) == _size_of(image, right) else (shown, "")
    if image.format != "MPO":
        return shown, ""
    kinds = [entry["Attribute"]["MPType"] for entry in image.mpinfo[MP_ENTRIES]]
    if kinds[1] != DISPARITY and not (kinds[1] == UNDEFINED and is_named_so):
        return shown, ""
    size = image.size
    try:
        image.seek(1)
    except Exception:  # as every decoder's
        return (0,), "the second picture is missing, so both eyes see the first picture"
    extra = b"".join(content for _, content in image.applist)
    if image.size != size or image.layers != 3 or any(mark in extra for mark in GAIN_MAP):
        return (0,), ""
    return ((1, 0) if _viewpoint(image) == 1 else (0, 1)), ""


def _leia_view(coded: bytes | IO[bytes], size: tuple[int, int]) -> tuple[slice, bool] | None:
    """Return the result of `other_view`, or None if the other view is not a picture of the same size."""
    file = io.BytesIO(coded) if isinstance(coded, bytes) else coded
    if found := other_view(file):
        file.seek(found[0].start)
        with suppress(ValueError):
            if picture_size(file.read(min(found[0].stop - found[0].start, LIMITS.file_bytes))) == size:
                return found
    return None


def _jps_layout(image: Any) -> str:
    """Return the layout in a JPEG's stereo header (JPS), as in `content.layout`, or an empty string."""
    for name, data in getattr(image, "applist", ()):
        if name == "APP3" and data[:8] == JPS and len(data) >= JPS_BYTES:
            flags, kind, is_stereo = data[11], JPS_LAYOUTS.get(data[12], ""), data[13] == 1
            if not is_stereo or (kind == "top-bottom" and not flags & JPS_LEFT_FIRST):
                return ""
            if kind == "side-by-side" and not flags & JPS_LEFT_FIRST:
                return "cross-eyed"
            is_half = flags & (JPS_HALF_WIDTH if kind == "side-by-side" else JPS_HALF_HEIGHT)
            return f"half-{kind}" if is_half and kind != "anaglyph" else kind
    return ""


def _xmp(image: Any) -> bytes:
    told = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    return told.encode() if isinstance(told, str) else bytes(told)


def _size_of(image: Any, frame: int) -> tuple[int, int]:
    image.seek(frame)
    size: tuple[int, int] = image.size
    return size


def _viewpoint(image: Any) -> int | None:
    """Return the number of a frame's viewpoint in an MPO, where 1 is leftmost, or None if unknown."""
    from PIL import TiffImagePlugin

    with suppress(Exception):  # a malformed table has no number
        file = io.BytesIO(image.info["mp"])
        table = TiffImagePlugin.ImageFileDirectory_v2(file.read(8))
        file.seek(struct.unpack((">" if file.getvalue()[:1] == b"M" else "<") + "L", file.getvalue()[4:8])[0])
        table.load(file)
        return int(table[MP_NUMBER])
    return None


def picture_size(coded: bytes) -> tuple[int, int]:
    """Return the stored width and height of an encoded picture.

    Raises ValueError if its header cannot be decoded.
    """
    try:
        with opened(coded) as image:
            width, height = image.size
            return width, height
    except Exception as error:  # each of Pillow's formats raises its own
        raise ValueError(undecodable(coded, error)) from None


def undecodable(data: bytes, error: Exception | None = None) -> str:
    """Return why a picture cannot be decoded: an unsupported format, with a remedy, or a damaged file."""
    from PIL import UnidentifiedImageError

    if not data:
        return "is empty"
    brand = data[8:12] if data[4:8] == b"ftyp" else b""
    if brand in (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1") and "HEIF" not in _formats():
        return f"is HEIC, which requires the extra `heic` (pip install pillow-heif); otherwise {ANOTHER}"
    for place, mark, name, way_out in OTHER_KINDS:
        if data[place : place + len(mark)] == mark and (mark != b"CR" or data[:2] in (b"II", b"MM")):
            return f"is {name}, which is not supported; {way_out}"
    if data[:5] == b"<?xml" and b"<svg" in data[:HEAD_BYTES]:
        return f"is SVG, which is not supported; {ANOTHER}"
    if data.lstrip()[:1] == b"{" and b'"frames"' in data:
        return f"is a set of cameras for training a NeRF; {CAMERA_SET}"
    told = str(error).lower()
    if is_cut_off(data) or _promises_more(data) or "truncated" in told or "end of file" in told:
        return f"{UNDECODED} because the file is truncated"
    return (
        UNDECODED
        if error is None or isinstance(error, UnidentifiedImageError)
        else f"{UNDECODED} because the file is damaged"
    )


def _promises_more(data: bytes) -> bool:
    """Return True if a WebP, or a box of an AVIF or HEIC, declares more bytes than the file has."""
    if data[:4] == b"RIFF":
        return 8 + int.from_bytes(data[4:8], "little") > len(data)
    place = 0
    while data[4:8] == b"ftyp" and place + 8 <= len(data):
        size = int.from_bytes(data[place : place + 4], "big")
        if size < 8:  # the box extends to the end of the file or has a 64-bit size; cameras write neither
            return False
        place += size
    return place > len(data)


def is_cut_off(coded: bytes) -> bool:
    """Return True if the chunks of a PNG exceed the file or its end is missing. False for other formats.

    OpenCV allocates the declared size before reading, up to 2 GiB for a file of any size.
    """
    if not coded.startswith(PNG):
        return False
    place = len(PNG)
    while place + CHUNK_BYTES <= len(coded):
        length, kind = int.from_bytes(coded[place : place + 4], "big"), coded[place + 4 : place + 8]
        place += CHUNK_BYTES + length
        if kind == b"IEND" and place <= len(coded):
            return False
    return True


def _orientation(image: Any) -> int:
    """Return the EXIF orientation stored before the pixels. Pillow rotates TIFF itself.

    Pillow's `getexif` is not used, because it would unpack a PNG.
    """
    from PIL import Image

    coded = image.info.get("exif")
    if image.format == "TIFF" or not isinstance(coded, bytes):
        return 1
    exif = Image.Exif()
    with suppress(Exception):  # a malformed orientation is ignored
        exif.load(coded)
    found = exif.get(ORIENTATION)
    return found if isinstance(found, int) else 1


def check_size(
    width_px: int, height_px: int, *, source: str | Path, field: str = "", name: str = "", head: bytes = b""
) -> None:
    """Raise InputError for more pixels than the limit, half of it for a PNG with 16 bits per channel.

    name: the picture's name within `source`. head: beginning of the coded picture, if known.
    """
    is_deep = head.startswith(PNG) and head[PNG_DEPTH] == b"\x10"
    most = LIMITS.pixels // (2 if is_deep else 1)
    if max(width_px, height_px) > SIDE_MAX_PX or width_px * height_px > most:
        problem = f"has {width_px} x {height_px} pixels{' of 16 bits per channel' * is_deep}; the maximum is {most:,}"
        raise InputError(source, field, f"{name} {problem}".strip())


def decoded_picture(coded: bytes, *, source: str | Path, field: str, name: str) -> Any:
    """Decode a picture. Raises InputError if it is damaged, incomplete or exceeds the size limit."""
    try:
        width, height = picture_size(coded)
        check_size(width, height, source=source, field=field, name=name, head=coded)
        with opened(coded) as image:
            image.load()
            return image
    except InputError:
        raise
    except Exception as error:  # each of Pillow's decoders raises its own
        raise InputError(source, field, f"{name} {undecodable(coded, error)}") from None


def camera_set_in(folder: Path) -> str:
    """Return why a folder with a camera set cannot be drawn, or an empty string if it has none."""
    sets = sorted(folder.glob("transforms*.json"))
    return f"contains a set of cameras for training a NeRF ({sets[0].name}); {CAMERA_SET}" if sets else ""


def read_coded(path: Path) -> tuple[bytes, Header]:
    """Read a picture file without decoding it, and check its header.

    Raises InputError if the file cannot be read, its header is refused, or it is a folder with a camera set.
    """
    if untrusted_input.is_there(path, folder=True) and (problem := camera_set_in(path)):
        raise InputError(path, "", problem)
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    return data, _header_of(path, data)


def header_of_file(path: Path) -> Header:
    """Return the header of a picture file.

    Raises InputError if the file cannot be read, is not a supported picture or exceeds the limit of pixels.
    """
    with untrusted_input.open_regular(path, most_bytes=LIMITS.file_bytes) as file:
        return _header_of(path, file)
