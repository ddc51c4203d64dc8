"""Read photographs from a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from runtime.errors import InputError
from runtime.records import U8
from runtime.support import untrusted_input
from runtime.support.picture_header import is_cut_off, read_coded

MAX_PHOTOGRAPHS = 100  # maximum number of photographs in a folder
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}


def photographs(folder: Path, *, colour: bool = False) -> Iterator[tuple[str, U8]]:
    """Yield the name and pixels of each photograph in a folder, by name. Raises InputError."""
    if not untrusted_input.is_there(folder, folder=True):
        raise InputError(folder, "", "is not a folder")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise InputError(folder, "", "contains no photographs; use " + ", ".join(sorted(SUFFIXES)))
    if len(paths) > MAX_PHOTOGRAPHS:
        raise InputError(folder, "", f"contains {len(paths)} pictures, but the maximum is {MAX_PHOTOGRAPHS}")
    for path in paths:
        yield path.name, read_photograph(path, colour=colour)


def read_photograph(path: Path, *, colour: bool = False) -> U8:
    """Read a photograph as grey pixels (h, w), or in `colour` as RGB (h, w, 3).

    The EXIF orientation is ignored. Raises InputError.
    """
    data, _ = read_coded(path)
    flags = (cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_IGNORE_ORIENTATION
    picture = None if is_cut_off(data) else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None:
        raise InputError(path, "", "cannot be decoded; use JPEG or PNG, and export HEIC as JPEG")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) if colour else picture, np.uint8)
