"""Read the view arrangement that a film file declares.

MP4 files declare it in the boxes `st3d` and `sv3d` or in XML, and Matroska files in the StereoMode element.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from runtime.support import untrusted_input

MOVIE_BYTES, HEAD_BYTES = 32 << 20, 1 << 20  # most bytes read from an MP4's `moov` box and from a Matroska file
BOXES_MAX = 10_000  # most top-level boxes read from an MP4 file
ST3D = re.compile(rb"\0\0\0\x0dst3d.{4}([\1\2])", re.DOTALL)
EQUI = re.compile(rb"\0\0\0\x1cequi.{12}(.{4})(.{4})", re.DOTALL)  # the groups are the crops on the left and right
XML_STEREO = re.compile(rb"GSpherical:StereoMode>\s*(left-right|top-bottom)")
XML_AROUND = re.compile(rb"GSpherical:Spherical>\s*true")
MULTIVIEW = b"vexu"  # box found in films recorded by headsets and phones
SEGMENT, TRACKS, TRACK, VIDEO, STEREO_MODE = 0x18538067, 0x1654AE6B, 0xAE, 0xE0, 0x53B8
MODES = {1: "side-by-side", 3: "top-bottom", 10: "anaglyph", 11: "cross-eyed"}


@dataclass(frozen=True, slots=True)
class FilmHeader:
    """The view arrangement declared by a film file. Fields it does not declare are empty or 0."""

    layout: str = ""  # in the syntax of `content.layout`
    span_deg: int = 0  # longitude covered by equirectangular views
    left_out: str = ""  # description of a view that is declared but not supported


def film_header(path: Path) -> FilmHeader:
    """Return what a film file declares about its views. Raises InputError if the file cannot be read."""
    with untrusted_input.open_regular(path) as file:
        if file.read(4) == b"\x1a\x45\xdf\xa3":
            return _matroska(file)
        return _mp4(file)


def _mp4(file: IO[bytes]) -> FilmHeader:
    movie, place, size = b"", 0, file.seek(0, 2)
    for _ in range(BOXES_MAX):
        file.seek(place)
        head = file.read(16)
        length, kind = int.from_bytes(head[:4], "big"), head[4:8]
        length = int.from_bytes(head[8:], "big") if length == 1 else length or size - place
        if kind == b"moov":
            file.seek(place)
            movie = file.read(min(length, MOVIE_BYTES))
        place += length
        if movie or length < 8 or place >= size:
            break
    layout = span_deg = 0
    if found := ST3D.search(movie):
        layout = found[1][0]
    elif xml := XML_STEREO.search(movie):
        layout = 1 if xml[1] == b"top-bottom" else 2
    if found := EQUI.search(movie):
        cut = sum(int.from_bytes(side, "big") for side in found.groups()) / (1 << 32)
        span_deg = 180 if cut > 0.25 else 360
    elif XML_AROUND.search(movie):
        span_deg = 360
    left_out = "its second view (MV-HEVC); convert it to side by side" if MULTIVIEW in movie else ""
    return FilmHeader(("", "top-bottom", "side-by-side")[layout], span_deg, left_out)


def _matroska(file: IO[bytes]) -> FilmHeader:
    file.seek(0)
    data, places = file.read(HEAD_BYTES), [slice(0, HEAD_BYTES)]
    for wanted in (SEGMENT, TRACKS, TRACK, VIDEO, STEREO_MODE):
        places = [held for place in places for number, held in _elements(data, place) if number == wanted]
    mode = max((int.from_bytes(data[place], "big") for place in places), default=0)
    left_out = "" if not mode or mode in MODES else f"its second view (stereo mode {mode}); convert it to side by side"
    return FilmHeader(MODES.get(mode, ""), left_out=left_out)


def _elements(data: bytes, within: slice) -> Iterator[tuple[int, slice]]:
    """Yield each Matroska element's number and content range within a part of `data`."""
    place, end = within.start, min(within.stop, len(data))
    while place < end:
        number_bytes = 9 - data[place].bit_length()
        number, place = int.from_bytes(data[place : place + number_bytes], "big"), place + number_bytes
        if place >= end or number_bytes > 8:
            return
        size_bytes = 9 - data[place].bit_length()
        size = int.from_bytes(data[place : place + size_bytes], "big") & ((1 << 7 * size_bytes) - 1)
        place += size_bytes
        yield number, slice(place, place + size)
        place += size
