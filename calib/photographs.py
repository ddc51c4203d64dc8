"""A folder of photographs that a person took."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from runtime.errors import InputError
from runtime.records import U8
from runtime.support import untrusted_input
from runtime.support.picture_header import is_cut_off, read_coded

MAX_PHOTOGRAPHS = 100  # of one folder
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}


def photographs(folder: Path) -> Iterator[tuple[str, U8]]:
    """The photographs (h, w) of a folder with their names, in the order of these. Raises InputError."""
    if not untrusted_input.is_there(folder, folder=True):
        raise InputError(folder, "", "is not a folder of photographs")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not found:
        raise InputError(folder, "", "holds no photograph (" + ", ".join(sorted(SUFFIXES)) + ")")
    if len(found) > MAX_PHOTOGRAPHS:
        raise InputError(folder, "", f"holds {len(found)} pictures: at most {MAX_PHOTOGRAPHS}")
    for path in found:
        yield path.name, read_photograph(path)


def read_photograph(path: Path) -> U8:
    """(h, w) grey, as the camera saw it: a note to turn it is not heeded. Raises InputError."""
    data, _ = read_coded(path)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    picture = None if is_cut_off(data) else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None:
        raise InputError(path, "", "is not a photograph that can be decoded (JPEG or PNG; export HEIC as JPEG)")
    return np.asarray(picture)
