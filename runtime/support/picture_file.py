"""Read stills, stereo pairs and animations as upright 8-bit sRGB pictures over a background colour."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageCms, ImageOps

from runtime.errors import InputError
from runtime.records import U8
from runtime.support.artifacts import held_back
from runtime.support.coded_colours import Colour, composed, stated_profile
from runtime.support.picture_header import ORIENTATION, check_size, is_cut_off, opened, read_coded, undecodable
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.pictures")

WHITE: Colour = (1.0, 1.0, 1.0)
ROWS_AT_ONCE = 64  # number of rows converted together, to limit memory use
LATTICE = 9  # a colour profile is compared with sRGB at this number of values per channel
SRGB_CODES = 2  # a profile counts as sRGB if its code values differ by at most this
STILL_MS = 100.0  # duration used for an animation frame that declares 0, as in browsers
DEEP = {"I;16": "<u2", "I;16L": "<u2", "I;16B": ">u2", "I;16N": "=u2"}  # Pillow's 16-bit modes


def read_image(path: Path) -> U8:
    """Read the first picture in a file as 8-bit sRGB (h, w, 3), over white. Raises InputError if the file
    cannot be decoded, or has too many pixels, which is checked before decoding.
    """
    return read_views(path)[0]


def read_views(path: Path, *, background: Colour = WHITE) -> list[U8]:
    """Read a stereo pair's left and right picture, or a single picture, as `read_image` does."""
    data, header = read_coded(path)
    if header.warning:
        log.warning("%s: %s", path, header.warning)
    if header.other is not None:
        coded = [(data, data[header.other])[number] for number in header.views]
        return [picture for one in coded for picture, _ in _decoded(path, one, (0,), background)]
    return [picture for picture, _ in _decoded(path, data, header.views, background)]


def read_animation(path: Path, *, background: Colour = WHITE) -> tuple[list[U8], list[float]]:
    """Read the frames of an animated picture, and the duration of each in ms. Raises as `read_image`. If
    the frames' total pixel count exceeds the limit for a single picture, only the first frame is read and a warning is
    logged.
    """
    data, header = read_coded(path)
    with opened(data) as image:
        numbers = range(1 if image.info.get("default_image") else 0, image.n_frames)
    if len(numbers) * header.width_px * header.height_px > LIMITS.pixels:
        size = f"{header.width_px} x {header.height_px}"
        total = f"{len(numbers)} frames of {size} pixels, which exceeds the limit of {LIMITS.pixels:,} pixels in total"
        log.warning("%s has %s; showing only its first frame", path, total)
        numbers = numbers[:1]
    frames = list(_decoded(path, data, tuple(numbers), background))
    return [picture for picture, _ in frames], [shown_ms for _, shown_ms in frames]


def _decoded(path: Path, data: bytes, frames: tuple[int, ...], background: Colour) -> Iterator[tuple[U8, float]]:
    """Yield frames as 8-bit sRGB, each with its duration in ms. Raises InputError as `read_image`."""
    if is_cut_off(data):
        raise InputError(path, "", undecodable(data))
    try:
        with held_back(), opened(data) as image:
            for number in frames:
                if image.tell() != number:
                    image.seek(number)
                    check_size(*image.size, source=path)
                image.load()
                shown_ms = float(image.info.get("duration") or 0) or STILL_MS
                if not image.info.get("icc_profile"):
                    image.info["icc_profile"] = stated_profile(data)
                yield rgb_of(image, path, background=background), shown_ms
    except InputError:
        raise
    except Exception as error:  # the class of the exception depends on Pillow's decoder
        raise InputError(path, "", undecodable(data, error)) from None


def rgb_of(image: Any, source: object, *, background: Colour = WHITE) -> U8:
    """Convert a decoded Pillow image, by its orientation and colour profile, to 8-bit sRGB (h, w, 3).
    Raises InputError if the image has 32-bit values without a defined range.
    """
    profile = image.info.get("icc_profile")
    image = _upright(image)
    if image.mode == "F" or (image.mode == "I" and image.format not in (None, "PPM")):
        raise InputError(
            str(source), "", "has 32-bit values without a defined range; save the picture with 8 or 16 bits per channel"
        )
    colours = "CMYK" if image.mode == "CMYK" else "L" if image.mode in ("1", "L", "LA", *DEEP) else "RGB"
    to_srgb = _to_srgb(profile, colours, source) if profile else None
    is_clear = image.has_transparency_data
    result = np.empty((image.height, image.width, 3), np.uint8)
    for first in range(0, image.height, ROWS_AT_ONCE):  # intermediate values need several times the result's memory
        rows = slice(first, min(first + ROWS_AT_ONCE, image.height))
        part = _eight_bits(image.crop((0, rows.start, image.width, rows.stop)))
        alpha = np.asarray(part.convert("RGBA"))[..., 3:] if is_clear else None
        part = part.convert(colours)
        result[rows] = np.asarray(to_srgb(part) if to_srgb else part.convert("RGB"))
        if alpha is not None:
            result[rows] = composed(result[rows], alpha, background)
    return result


def _upright(image: Any) -> Any:
    with suppress(Exception):  # ignore malformed EXIF data
        if image.getexif().get(ORIENTATION, 1) != 1:
            return ImageOps.exif_transpose(image)
    return image


def _eight_bits(image: Any) -> Any:
    """Reduce 16-bit channels to the upper 8 bits. Other images are returned unchanged."""
    if image.mode == "I":
        return Image.fromarray((np.asarray(image).clip(0, 65535) >> 8).astype(np.uint8))
    if image.mode in DEEP:
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    return image


def _to_srgb(profile: bytes, colours: str, source: object) -> Any:
    """Return a function that converts images (`L`, `RGB` or `CMYK`) from an ICC profile to sRGB. None if the profile is
    broken or close to sRGB.
    """
    try:
        transform = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)),
            ImageCms.createProfile("sRGB"),
            colours,
            "RGB",
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
    except Exception as error:  # like browsers, ignore a broken profile or one for another colour space
        log.info("%s: ignoring the colour profile: %s", source, error)
        return None
    if colours == "CMYK":
        return transform.apply
    channels = 1 if colours == "L" else 3
    steps = [np.linspace(0, 255, LATTICE).astype(np.uint8)] * channels
    codes = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(1, -1, channels)
    plain = Image.fromarray(codes[..., 0] if channels == 1 else codes)
    off = np.asarray(transform.apply(plain)).astype(int) - np.asarray(plain.convert("RGB"))
    return transform.apply if np.abs(off).max() > SRGB_CODES else None
