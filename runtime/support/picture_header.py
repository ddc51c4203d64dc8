"""A picture's size from its header, checked against the limits before it is decoded."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import IO, Any

from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.untrusted_input import LIMITS

PNG = b"\x89PNG\r\n\x1a\n"
PNG_DEPTH = slice(24, 25)  # where a PNG has its bits a channel
CHUNK_BYTES = 12  # of a PNG's part without what it holds: length, kind, checksum
SIDE_MAX_PX = 1 << 16  # that a header may claim
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "TGA")  # Pillow's; of EPS it would start Ghostscript
ORIENTATION = 0x0112  # EXIF's tag
TURNED = (5, 6, 7, 8)  # by a quarter: width and height are exchanged


def picture_size(coded: bytes | IO[bytes], *, turned: bool = False) -> tuple[int, int]:
    """Width and height of a coded picture; turned: after its EXIF orientation. Raises ValueError."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own warning of large pictures: the caller has limits
        most, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            with Image.open(io.BytesIO(coded) if isinstance(coded, bytes) else coded, formats=FORMATS) as image:
                width, height = image.size
                is_turned = turned and _orientation(image) in TURNED
        except Exception as error:  # each of Pillow's formats raises its own
            raise ValueError(f"not a picture that can be read ({type(error).__name__})") from None
        finally:
            Image.MAX_IMAGE_PIXELS = most
    return (height, width) if is_turned else (width, height)


def is_cut_off(coded: bytes) -> bool:
    """Whether a PNG's parts promise more bytes than there are, or it has no end. False for other formats.

    OpenCV takes memory for what is promised before it reads: up to 2 GiB for a file of any size.
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
    """By what stands before the pixels: Pillow's own `getexif` unpacks a PNG. Of a TIFF it tells the turned size."""
    from PIL import Image

    coded = image.info.get("exif")
    if image.format == "TIFF" or not isinstance(coded, bytes):
        return 1
    exif = Image.Exif()
    exif.load(coded)
    found = exif.get(ORIENTATION)
    return found if isinstance(found, int) else 1


def check_size(
    width_px: int, height_px: int, *, source: str | Path, field: str = "", name: str = "", head: bytes = b""
) -> None:
    """Raise InputError for more pixels than the limit, or half of it for a PNG with 16 bits a channel.

    name: of a picture within `source`. head: the coded picture's beginning, where it is known.
    """
    is_deep = head.startswith(PNG) and head[PNG_DEPTH] == b"\x10"
    most = LIMITS.pixels // (2 if is_deep else 1)
    if max(width_px, height_px) > SIDE_MAX_PX or width_px * height_px > most:
        problem = f"has {width_px} x {height_px} pixels{' of 16 bits a channel' * is_deep}; at most {most:,}"
        raise InputError(source, field, f"{name} {problem}".strip())


def decoded_picture(coded: bytes, *, source: str | Path, field: str, name: str) -> Any:
    """Pillow's image of a picture that is whole and within the limit. Raises InputError."""
    from PIL import Image

    try:
        width, height = picture_size(coded)
        check_size(width, height, source=source, field=field, name=name, head=coded)
        image = Image.open(io.BytesIO(coded), formats=FORMATS)
        image.load()
        return image
    except InputError:
        raise
    except Exception:  # each of Pillow's decoders raises its own
        raise InputError(source, field, f"{name} is not an image that can be decoded") from None


def read_coded(path: Path) -> bytes:
    """A picture file's undecoded bytes, checked by its header. Raises InputError."""
    data = untrusted_input.read_bytes(path, most_bytes=LIMITS.file_bytes)
    try:
        width, height = picture_size(data)
    except ValueError:
        raise InputError(path, "", "is not an image that can be decoded") from None
    check_size(width, height, source=path, head=data)
    return data


def size_of_file(path: Path) -> tuple[int, int]:
    """Width and height as a decoder shows them, from the file's beginning. Raises InputError."""
    with untrusted_input.open_regular(path, most_bytes=LIMITS.file_bytes) as file:
        try:
            width, height = picture_size(file, turned=True)
        except ValueError:
            raise InputError(path, "", "is not an image that can be decoded") from None
    check_size(width, height, source=path)
    return width, height
