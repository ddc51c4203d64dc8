"""Pictures that drawing programs are asked for, and their form."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from PIL import Image

from runtime.records import F32, U8, U16

ANSWERED_S = 0.4  # time limit for all of a frame's pictures
IN_FLIGHT_MAX = 2  # largest number of frames requested but not yet answered
SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class AskedViews:
    """Views that programs are asked to draw, in the form sent to them."""

    time_ns: int  # on the run's clock
    width_px: int
    height_px: int
    eyes: tuple[dict[str, Any], ...]  # see `program.camera_of`; `eye` is left or right
    display_m: tuple[float, float]  # width and height of the panels

    @property
    def sides(self) -> tuple[int, ...]:
        return tuple(SIDES.index(eye["eye"]) for eye in self.eyes)


@dataclass(frozen=True, slots=True)
class ProgramPicture:
    """An eye's picture, with the top row first. It may be smaller than requested."""

    pixels: U8  # RGBA (h, w, 4)
    depth: F32 | U16 | None  # (h, w) values of the depth buffer, or None if the program does not send it
    place: SharedPlace | None = None  # where the program has written it; None: it was sent

    def replace(self, other: ProgramPicture) -> None:
        """Overwrite the picture with another one of the same form."""
        np.copyto(self.pixels, other.pixels)
        if self.depth is not None and other.depth is not None:
            np.copyto(self.depth, other.depth)


@dataclass(frozen=True, slots=True)
class DrawnPictures:
    """A frame's complete set of pictures."""

    number: int  # of the frame, as returned by `ask`
    pictures: Mapping[int, ProgramPicture]  # keyed by side


@dataclass(frozen=True, slots=True)
class SharedPlace:
    """Place of a picture in memory that a program shares with all processes of its user."""

    path: str
    memory_bytes: int
    at: int  # offset of the picture in bytes
    form: PictureForm


@dataclass(frozen=True, slots=True)
class PictureForm:
    """Size and parts of a program's pictures."""

    width_px: int
    height_px: int
    depth: np.dtype[Any] | None
    bottom_up: bool
    encoding: str = "raw"

    @property
    def depth_bytes(self) -> int:
        return 0 if self.depth is None else self.depth.itemsize * self.width_px * self.height_px

    @property
    def pixels_bytes(self) -> int:
        return 4 * self.width_px * self.height_px

    @property
    def bytes(self) -> int:
        return self.pixels_bytes + self.depth_bytes

    def received(self, data: memoryview) -> ProgramPicture:
        """Return the picture in a message. Raises ValueError if it has the wrong size or encoding."""
        if self.encoding == "raw":
            return self.picture(data)
        end = max(len(data) - self.depth_bytes, 0)
        pixels = decoded_jpeg(bytes(data[:end]), self.width_px, self.height_px)
        return ProgramPicture(pixels[:: self._order], self._depth_in(data[end:]))

    def picture(self, data: memoryview, place: SharedPlace | None = None) -> ProgramPicture:
        """Return the raw picture in a message or in shared memory, not copied.

        Raises ValueError if the data has the wrong size.
        """
        if len(data) != self.bytes:
            parts = "RGBA pixels" if self.depth is None else f"RGBA pixels and {self.depth.name} depths"
            raise ValueError(f"the answer has {len(data)} bytes, which is not {self.width_px}x{self.height_px} {parts}")
        pixels = np.frombuffer(data[: self.pixels_bytes], np.uint8).reshape(self.height_px, self.width_px, 4)
        return ProgramPicture(pixels[:: self._order], self._depth_in(data[self.pixels_bytes :]), place)

    @property
    def _order(self) -> int:
        return -1 if self.bottom_up else 1

    def _depth_in(self, data: memoryview) -> F32 | U16 | None:
        if self.depth is None:
            return None
        return np.frombuffer(data, self.depth).reshape(self.height_px, self.width_px)[:: self._order]


def decoded_jpeg(data: bytes, width_px: int, height_px: int) -> U8:
    """Return the RGBA pixels (h, w, 4) of a JPEG. Raises ValueError if it is invalid or has another size."""
    try:
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as header:
            size = header.size
    except (OSError, ValueError):
        raise ValueError("the answer is not a JPEG picture") from None
    if size != (width_px, height_px):
        raise ValueError(f"the answer is a picture of {size[0]}x{size[1]} pixels, not {width_px}x{height_px}")
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError("the answer is not a JPEG picture")
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGBA), np.uint8)
