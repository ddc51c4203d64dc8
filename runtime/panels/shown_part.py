"""The part of a picture that a solution fills; the rest code around it is neither drawn nor copied."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.kernels import library
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64, U8

MARGIN_PX = 2  # for interpolation, in the pixels of both pictures
EVERY_PX = 2  # parts begin at even pixels, so that every other pixel is the same in all of them


Map = tuple[float, float, float, float]  # scales across and down, shifts across and down
UNMOVED: Map = (1.0, 1.0, 0.0, 0.0)
NO_PUSH: Map = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ShownPicture:
    """A picture to draw on a panel's screen (`runtime.kernels.compiled.PanelPicture`)."""

    source: U8  # (h, w, 4) RGBA
    screen: U8  # (h, w, 4) BGRX, to be drawn
    source_from_panel: Map
    panel_from_screen: F64 | None = None  # 3x3 homography; None if their pixels coincide
    panel_px: tuple[int, int] = (0, 0)  # rows and columns of a registered panel
    relief: F32 | None = None
    relief_from_screen: Map = UNMOVED
    push: Map = NO_PUSH  # displacement, in the source's pixels, by a relief of 1
    flat: U8 | None = None  # picture of the screen's size to mix in
    flatness: float = 0.0  # its weight
    curve: NDArray[np.uint32] | None = None  # (3, CURVE_ENTRIES)
    every: int = 1  # 2: every other pixel is sampled

    def checked(self) -> object:
        """Return what the compiled functions take. Raises ValueError if anything does not fit."""
        return library().PanelPicture(
            self.source, self.screen, self.source_from_panel, self.panel_from_screen, self.panel_px, self.relief,
            self.relief_from_screen, self.push, self.flat, self.flatness, self.curve, self.every,
        )  # fmt: skip


def filled_part(shown: ShownPicture, box: PixelRect, *, rise: float = 0.0, screen_from_panel: F64 | None) -> PixelRect:
    """Return the part of the screen that shows a box of the layer, in pixels of `shown.source`. `rise` is
    the largest absolute relief. `screen_from_panel` is None if pixels coincide.
    """
    screen_rows, screen_columns = shown.screen.shape[:2]
    if not box.width_px or not box.height_px:
        return PixelRect(0, 0, 0, 0)
    rows, columns = (screen_rows, screen_columns) if screen_from_panel is None else shown.panel_px
    scale_u, scale_v, shift_u, shift_v = shown.source_from_panel
    push_scale_u, push_scale_v, push_shift_u, push_shift_v = shown.push
    left, right = _reached(box.u0, box.u1, scale_u, shift_u, rise * _most(push_scale_u, push_shift_u, columns))
    top, bottom = _reached(box.v0, box.v1, scale_v, shift_v, rise * _most(push_scale_v, push_shift_v, rows))
    if screen_from_panel is not None:
        corners = np.array([[left, top, 1.0], [right, top, 1.0], [left, bottom, 1.0], [right, bottom, 1.0]])
        u, v, w = screen_from_panel @ corners.T
        if min(w) <= 0:  # the part reaches the horizon
            return PixelRect(0, 0, screen_columns, screen_rows)
        left, right, top, bottom = min(u / w), max(u / w), min(v / w), max(v / w)
    u0, v0 = (max(math.floor(edge) - MARGIN_PX, 0) // EVERY_PX * EVERY_PX for edge in (left, top))
    u1, v1 = math.ceil(right) + MARGIN_PX, math.ceil(bottom) + MARGIN_PX
    return PixelRect(u0, v0, min(u1, screen_columns), min(v1, screen_rows))


def limited(shown: ShownPicture, part: PixelRect) -> ShownPicture:
    """Return the part of a picture without a flat one, to be drawn as in the whole."""
    screen = shown.screen[part.v0 : part.v1, part.u0 : part.u1]
    if shown.panel_from_screen is not None:
        screen_from_part = np.array([[1.0, 0.0, part.u0], [0.0, 1.0, part.v0], [0.0, 0.0, 1.0]])
        return replace(shown, screen=screen, panel_from_screen=shown.panel_from_screen @ screen_from_part)
    return replace(
        shown,
        screen=screen,
        source_from_panel=_moved(shown.source_from_panel, part),
        push=_moved(shown.push, part),
        relief_from_screen=_moved(shown.relief_from_screen, part),
    )


def _reached(first: int, end: int, scale: float, shift: float, push: float) -> tuple[float, float]:
    """Return where, on the panel, pixels first..end of the source contribute, if they are displaced by up to `push`."""
    return (first - MARGIN_PX - push - shift) / scale, (end + MARGIN_PX + push - shift) / scale


def _most(scale: float, shift: float, size_px: int) -> float:
    """Return the largest displacement by a relief of 1."""
    return max(abs(shift), abs(scale * size_px + shift))


def _moved(by: Map, part: PixelRect) -> Map:
    scale_u, scale_v, shift_u, shift_v = by
    return scale_u, scale_v, shift_u + scale_u * part.u0, shift_v + scale_v * part.v0
