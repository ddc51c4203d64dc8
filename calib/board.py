"""Coded calibration boards, whose marks identify a panel and a position on it.

A mark is a white square with an ArUco marker inside and a smaller white square at each corner. Where two squares touch
there is a saddle point. It is symmetric under a half turn, so it can be located to a few hundredths of a pixel despite
blur and the camera's tone curve. The rest of the board is black (phase 0), so the marks of other panels show through.
One photograph therefore shows the marks of all panels, and no tripod is needed. Marks are scattered so that two that
overlap from one viewpoint are separate from another.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

MARKER_BITS = 4
DICTIONARY_SIZE = 100
ACROSS, DOWN = 5, 4  # number of marks across and down a panel
PER_PANEL = ACROSS * DOWN
BITS_ON_SHORT_SIDE = 216  # bits along the shorter side; a bit is 5 pixels at 1080 rows
# In bits: the marker with its black border, the quiet zone on each side, the corner squares.
MARKER, QUIET, CORNER = MARKER_BITS + 2, 2, 3
SQUARE = MARKER + 2 * QUIET
TILE = SQUARE + 2 * CORNER


def dictionary() -> Any:
    """Return the ArUco dictionary of the markers."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)


@dataclass(frozen=True, slots=True)
class Mark:
    """Mark of a board."""

    number: int  # id of the marker
    panel: int
    left_px: int  # left edge of the white square
    top_px: int
    unit_px: int  # size of one bit of the marker

    @property
    def side_px(self) -> int:
        """Side length of the white square."""
        return SQUARE * self.unit_px

    @property
    def saddles_px(self) -> F64:
        """(4, 2) corners of the white square in panel pixels, clockwise from the top left."""
        u, v, side = self.left_px, self.top_px, self.side_px
        return np.array([[u, v], [u + side, v], [u + side, v + side], [u, v + side]], dtype=np.float64)

    @property
    def marker_px(self) -> F64:
        """(4, 2) corners of the marker itself, ordered as in `saddles_px`."""
        inset = QUIET * self.unit_px
        corners: F64 = self.saddles_px + inset * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        return corners


@lru_cache(maxsize=8)
def marks(stack: PanelStack) -> tuple[Mark, ...]:
    """Lay out the marks of all panels. Raises InputError if panels are too many or too small."""
    if stack.count * PER_PANEL > DICTIONARY_SIZE:
        raise InputError(
            "stack",
            "x_m",
            f"has more panels than the calibration boards support; the maximum is {DICTIONARY_SIZE // PER_PANEL}",
        )
    unit = max(2, round(min(stack.width_px * 9 / 16, stack.height_px) / BITS_ON_SHORT_SIDE))
    tile = TILE * unit
    cell = np.array([stack.width_px / ACROSS, stack.height_px / DOWN])
    room = cell - tile - 2
    if room.min() < 0:
        raise InputError(
            "stack",
            "width_px",
            f"is too small; the boards need panels of at least {ACROSS * tile}x{DOWN * tile} pixels",
        )
    every = []
    random = np.random.default_rng(16)  # fixed seed, because photographs are compared with the board
    for panel in range(stack.count):
        for place in range(PER_PANEL):
            corner = np.array([place % ACROSS, place // ACROSS]) * cell + 1 + random.uniform(size=2) * room
            left, top = np.rint(corner).astype(int) + CORNER * unit
            every.append(Mark(panel * PER_PANEL + place, panel, int(left), int(top), unit))
    return tuple(every)


def board(stack: PanelStack, panel: int) -> U8:
    """Draw the board of one panel (H, W), with values 0 and 255."""
    picture = np.zeros((stack.height_px, stack.width_px), np.uint8)
    for mark in marks(stack):
        if mark.panel != panel:
            continue
        side, corner, unit = mark.side_px, CORNER * mark.unit_px, mark.unit_px
        u, v = mark.left_px, mark.top_px
        picture[v : v + side, u : u + side] = 255
        for du, dv in ((-corner, -corner), (side, -corner), (side, side), (-corner, side)):
            picture[v + dv : v + dv + corner, u + du : u + du + corner] = 255
        inset = QUIET * unit
        marker = cv2.aruco.generateImageMarker(dictionary(), mark.number, MARKER * unit, borderBits=1)
        picture[v + inset : v + inset + MARKER * unit, u + inset : u + inset + MARKER * unit] = marker
    return picture


def boards(stack: PanelStack) -> U8:
    """Draw the boards of all panels (N, H, W)."""
    return np.stack([board(stack, index) for index in range(stack.count)])
