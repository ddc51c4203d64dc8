"""Draw calibration boards with coded marks that identify a panel and a position on the panel.

A mark is a white square that contains an ArUco marker and has a smaller white square at each corner. The brightness has
a saddle point where two squares touch. A saddle point looks the same after a half turn, so it can be located to within
a few hundredths of a pixel despite blur and the camera's tone curve.

The rest of a board is black (phase 0) and lets the other panels' marks show through. A single photograph therefore
shows every panel's marks, and no tripod is needed. The marks are placed irregularly so that marks that overlap as seen
from one viewpoint are separate as seen from another.
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
BITS_ON_SHORT_SIDE = 216  # marker bits along a panel's shorter side; a bit is 5 pixels wide at 1080 rows
# Sizes in bits: the marker with its black border, the quiet zone on each side, and a corner square.
MARKER, QUIET, CORNER = MARKER_BITS + 2, 2, 3
SQUARE = MARKER + 2 * QUIET
TILE = SQUARE + 2 * CORNER


def dictionary() -> Any:
    """Return the ArUco dictionary that supplies the markers."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)


@dataclass(frozen=True, slots=True)
class Mark:
    """Position and identity of one mark on a panel's board."""

    number: int  # ArUco marker id
    panel: int  # index of the panel that shows the mark
    left_px: int  # the white square's left edge
    top_px: int  # the white square's top edge
    unit_px: int  # side length of one marker bit

    @property
    def side_px(self) -> int:
        """The white square's side length in pixels."""
        return SQUARE * self.unit_px

    @property
    def saddles_px(self) -> F64:
        """The white square's corners in panel pixels, clockwise from the top left, as a (4, 2) array."""
        u, v, side = self.left_px, self.top_px, self.side_px
        return np.array([[u, v], [u + side, v], [u + side, v + side], [u, v + side]], dtype=np.float64)

    @property
    def marker_px(self) -> F64:
        """The ArUco marker's corners in panel pixels, clockwise from the top left, as a (4, 2) array."""
        inset = QUIET * self.unit_px
        corners: F64 = self.saddles_px + inset * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        return corners


@lru_cache(maxsize=8)
def marks(stack: PanelStack) -> tuple[Mark, ...]:
    """Lay out every panel's marks. Raises InputError if the panels are too small or there are too many."""
    if stack.count * PER_PANEL > DICTIONARY_SIZE:
        raise InputError(
            "stack",
            "x_m",
            f"has more panels than the calibration boards support (at most {DICTIONARY_SIZE // PER_PANEL})",
        )
    unit = max(2, round(min(stack.width_px * 9 / 16, stack.height_px) / BITS_ON_SHORT_SIDE))
    tile = TILE * unit
    cell = np.array([stack.width_px / ACROSS, stack.height_px / DOWN])
    room = cell - tile - 2
    if room.min() < 0:
        raise InputError(
            "stack",
            "width_px",
            f"is too small for the boards; panels must have at least {ACROSS * tile}x{DOWN * tile} pixels",
        )
    every = []
    random = np.random.default_rng(16)  # fixed seed, so that photographs match the board
    for panel in range(stack.count):
        for place in range(PER_PANEL):
            corner = np.array([place % ACROSS, place // ACROSS]) * cell + 1 + random.uniform(size=2) * room
            left, top = np.rint(corner).astype(int) + CORNER * unit
            every.append(Mark(panel * PER_PANEL + place, panel, int(left), int(top), unit))
    return tuple(every)


def board(stack: PanelStack, panel: int) -> U8:
    """Draw one panel's board as an (H, W) array of 0s and 255s."""
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
    """Draw every panel's board, as an (N, H, W) array."""
    return np.stack([board(stack, index) for index in range(stack.count)])
