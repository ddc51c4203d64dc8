"""Read picture file headers, and check them against the limits before decoding."""

from __future__ import annotations

import importlib.util
import io
import struct
import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any

from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.leia import other_view
from runtime.support.untrusted_input import LIMITS

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
PNG_DEPTH = slice(24, 25)  # where a PNG stores its bit depth
CHUNK_BYTES = 12  # overhead of a PNG chunk: length, kind and checksum
SIDE_MAX_PX = 1 << 16  # maximum width and height that a header may declare
# Pillow's names of the supported formats. EPS is excluded, because Pillow would start Ghostscript. JPEG includes MPO.
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "TGA", "AVIF")
ANIMATED = ("GIF", "PNG", "WEBP", "AVIF")
ORIENTATION = 0x0112  # EXIF tag
SPHERES, ASPECT_OFF = (1, 2, 4), 0.02  # width over height of a sphere or two, and its relative tolerance
TURNED = (5, 6, 7, 8)  # EXIF orientations with a quarter turn, which swaps width and height
MP_ENTRIES, MP_NUMBER = 0xB002, 0xB101  # MPO tags: list of pictures, and a picture's viewpoint (counted from the left)
DISPARITY, UNDEFINED = "Multi-Frame Image: (Disparity)", "Undefined"
JPS, JPS_BYTES = b"_JPSJPS_", 14  # marker and minimum length of a stereo header
JPS_LAYOUTS = {2: "side-by-side", 3: "top-bottom", 4: "anaglyph"}
JPS_HALF_HEIGHT, JPS_HALF_WIDTH, JPS_LEFT_FIRST = 1, 2, 4
GAIN_MAP = (b"hdrgm", b"21496-1")  # markers of a gain map, a second picture that holds only brightness
HEAD_BYTES = 512  # number of bytes at the beginning of a file used to identify its kind
UNDECODED = "cannot be decoded as an image"
ANOTHER = "save it as PNG, JPEG or AVIF"
CAMERA_SET = "train the scene first and open its splats (.ply), or open its folder of pictures as a slideshow"
VIDEOS = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")  # suffixes of films
RAW = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")  # mostly TIFF files
RAW_KIND = "a camera's raw picture", "develop it and save it as JPEG"
OTHER_KINDS = (  # unsupported formats, each with the offset and value of its marker, its name and a remedy
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

    kind: str  # Pillow's name of the format
    width_px: int
    height_px: int
    views: tuple[int, ...]  # index of the frame to show, or indices of the left and right eye's frames
    is_animated: bool
    is_around: bool = False  # True if XMP data and shape are those of a full sphere, also of a stereo pair
    warning: str = ""  # warning for the user, such as a missing second view; empty: none
    layout: str = ""  # arrangement of two views in one picture, from a JPEG's stereo header; empty: none
    other: slice | None = None  # byte range of the second view in a Leia picture


@contextmanager
def opened(coded: bytes | IO[bytes]) -> Iterator[Any]:
    """Open an encoded picture with Pillow, without decoding the pixels, and yield the Pillow image.
    Pillow's limits and warnings are disabled while any picture is open, because the callers apply stricter limits. For
    invalid pictures, the class of the exception depends on the format.
    """
    from PIL import Image

    file = io.BytesIO(coded) if isinstance(coded, bytes) else coded
    with _UNLIMITED, Image.open(file, formats=_formats()) as image:
        yield image


class _UnlimitedPillow:
    """Context manager, for any number of threads at once, within which Pillow has no limit and does not warn."""

    def __init__(self) -> None:
        self._lock, self._users, self._undo = threading.Lock(), 0, ExitStack()

    def __enter__(self) -> None:
        from PIL import Image

        with self._lock:
            self._users += 1
            if self._users == 1:
                self._undo.enter_context(warnings.catch_warnings())
                warnings.simplefilter("ignore")
                self._undo.callback(setattr, Image, "MAX_IMAGE_PIXELS", Image.MAX_IMAGE_PIXELS)
                Image.MAX_IMAGE_PIXELS = None

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if not self._users:
                self._undo.close()


_UNLIMITED = _UnlimitedPillow()


@cache
def _formats() -> tuple[str, ...]:
    """Return Pillow's names for the supported formats, including HEIF if the extra `heic` is installed."""
    if importlib.util.find_spec("pillow_heif") is None:
        return FORMATS
    import pillow_heif

    pillow_heif.register_heif_opener(thumbnails=False, decode_threads=1)
    return (*FORMATS, "HEIF")


def _header_of(path: Path, file: IO[bytes]) -> Header:
    """Read a picture's header. A second picture of undefined type counts as a view only if the suffix is .mpo. Raises
    InputError for a camera's raw picture, a header that cannot be decoded, or too many pixels.
    """
    if path.suffix.lower() in RAW:  # many raw files are TIFFs, and Pillow would show only their thumbnails
        raise InputError(path, "", "is {}, which is not supported; {}".format(*RAW_KIND))
    try:
        with opened(file) as image:
            width, height = image.size
            if _orientation(image) in TURNED:
                width, height = height, width
            is_animated = image.format in ANIMATED and bool(getattr(image, "is_animated", False))
            views, warning = _views(image, is_named_so=path.suffix.lower() == ".mpo")
            is_sphere = any(abs(width / height / aspect - 1) < ASPECT_OFF for aspect in SPHERES)
            is_around, layout, other = is_sphere and b"equirectangular" in _xmp(image), _jps_layout(image), None
            if image.format == "JPEG" and (found := _leia_view(file, image.size)):
                other, views = found[0], (1, 0) if found[1] else (0, 1)
            kind = image.format
        head = _beginning(file, HEAD_BYTES)
    except Exception as error:  # the class of the exception depends on Pillow's format
        raise InputError(path, "", undecodable(_beginning(file, LIMITS.file_bytes), error)) from None
    check_size(width, height, source=path, head=head)
    return Header(kind, width, height, views, is_animated, is_around, warning, layout, other)


def _beginning(file: IO[bytes], most_bytes: int) -> bytes:
    file.seek(0)
    return file.read(most_bytes)


def _views(image: Any, *, is_named_so: bool) -> tuple[tuple[int, ...], str]:
    """Return the indices of the left and right frames, or of a single one, and a warning or "". A second picture counts
    only if the file declares a stereo pair, or `is_named_so` (.mpo) and its type is undefined, and both have the same
    size.
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
    except Exception:  # the class of the exception depends on Pillow's decoder
        return (0,), "the second picture is missing, so both eyes see the first picture"
    extra = b"".join(content for _, content in image.applist)
    if image.size != size or image.layers != 3 or any(mark in extra for mark in GAIN_MAP):
        return (0,), ""
    return ((1, 0) if _viewpoint(image) == 1 else (0, 1)), ""


def _leia_view(file: IO[bytes], size: tuple[int, int]) -> tuple[slice, bool] | None:
    """Return the result of `other_view`, or None if the second view does not have the first one's (width, height)."""
    if found := other_view(file):
        file.seek(found[0].start)
        with suppress(ValueError):
            if picture_size(file.read(min(found[0].stop - found[0].start, LIMITS.file_bytes))) == size:
                return found
    return None


def _jps_layout(image: Any) -> str:
    """Return the layout, as in `content.layout`, declared by a JPEG's stereo header (JPS), or ""."""
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
    """Return the viewpoint number of an MPO's current frame, or None if unknown. Number 1 is leftmost."""
    from PIL import TiffImagePlugin

    with suppress(Exception):  # treat a malformed table like a missing number
        file = io.BytesIO(image.info["mp"])
        table = TiffImagePlugin.ImageFileDirectory_v2(file.read(8))
        file.seek(struct.unpack((">" if file.getvalue()[:1] == b"M" else "<") + "L", file.getvalue()[4:8])[0])
        table.load(file)
        return int(table[MP_NUMBER])
    return None


def picture_size(coded: bytes) -> tuple[int, int]:
    """Return an encoded picture's stored width and height, before rotation. Raises ValueError."""
    try:
        with opened(coded) as image:
            width, height = image.size
            return width, height
    except Exception as error:  # the class of the exception depends on Pillow's format
        raise ValueError(undecodable(coded, error)) from None


def undecodable(data: bytes, error: Exception | None = None) -> str:
    """Return why a picture cannot be decoded, as the end of a message: a remedy for its format, or
    damage. `error` is Pillow's, or None if the picture was not opened.
    """
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
    """Return True if a WebP, AVIF or HEIC picture declares more bytes than the file contains."""
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
    """Return True if a PNG is incomplete: a chunk extends beyond the file, or the last chunk is missing.
    For an incomplete picture, OpenCV would allocate the size declared in the header, which can be up to 2 GiB however
    small the file is.
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
    """Return the EXIF orientation stored before the pixels, or 1. Pillow rotates TIFF pictures itself. Pillow's
    `getexif` is not suitable, because it would decompress a whole PNG.
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
    """Check a picture's size against the limits, half for PNGs with 16 bits a channel, by `head`, its
    first bytes. Raises InputError, which names `source`, `field` and `name`, for too many pixels or a side above
    SIDE_MAX_PX.
    """
    is_deep = head.startswith(PNG) and head[PNG_DEPTH] == b"\x10"
    most = LIMITS.pixels // (2 if is_deep else 1)
    if max(width_px, height_px) > SIDE_MAX_PX or width_px * height_px > most:
        problem = f"has {width_px} x {height_px} pixels{' of 16 bits per channel' * is_deep}; the maximum is {most:,}"
        raise InputError(source, field, f"{name} {problem}".strip())


def decoded_picture(coded: bytes, *, source: str | Path, field: str, name: str) -> Any:
    """Decode a picture contained in a file to a Pillow image. Raises InputError, which names `source`,
    `field` and `name`, if it is damaged, incomplete or too large.
    """
    try:
        width, height = picture_size(coded)
        check_size(width, height, source=source, field=field, name=name, head=coded)
        with opened(coded) as image:
            image.load()
            return image
    except InputError:
        raise
    except Exception as error:  # the class of the exception depends on Pillow's decoder
        raise InputError(source, field, f"{name} {undecodable(coded, error)}") from None


def camera_set_in(folder: Path) -> str:
    """Return a message if a folder contains photos with camera poses, as for a NeRF, or else ""."""
    sets = sorted(folder.glob("transforms*.json"))
    return f"contains a set of cameras for training a NeRF ({sets[0].name}); {CAMERA_SET}" if sets else ""


def read_coded(path: Path) -> tuple[bytes, Header]:
    """Read a picture file's bytes and its checked header. Raises InputError."""
    if untrusted_input.is_there(path, folder=True) and (problem := camera_set_in(path)):
        raise InputError(path, "", problem)
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    return data, _header_of(path, io.BytesIO(data))


def header_of_file(path: Path) -> Header:
    """Read and check a picture file's header. Raises InputError."""
    with untrusted_input.open_regular(path, most_bytes=LIMITS.file_bytes) as file:
        return _header_of(path, file)
