"""The part of a picture that a solution fills; the rest code around it is neither drawn nor copied."""

from __future__ import annotations

import math

import numpy as np

from runtime.kernels import ScaleShift, ShownPanel
from runtime.optics.rect import PixelRect
from runtime.records import F64

MARGIN_PX = 2  # for interpolation, in the pixels of both pictures
EVERY_PX = 2  # parts begin at even pixels, so that every other pixel is the same in all of them


def filled_part(shown: ShownPanel, box: PixelRect, *, rise: float = 0.0, screen_from_panel: F64 | None) -> PixelRect:
    """Return the part of the screen that shows a box of the layer, in pixels of `shown.source`. `rise` is
    the largest absolute relief. `screen_from_panel` is None if pixels coincide.
    """
    whole = PixelRect(0, 0, shown.columns, shown.rows)
    if not box.width_px or not box.height_px:
        return PixelRect(0, 0, 0, 0)
    columns, rows = shown.columns, shown.rows
    if screen_from_panel is not None:
        columns, rows = shown.panel_columns, shown.panel_rows
    to, push = shown.source_from_panel, shown.push
    left, right = _reached(box.u0, box.u1, to.scale_u, to.shift_u, rise * _most(push.scale_u, push.shift_u, columns))
    top, bottom = _reached(box.v0, box.v1, to.scale_v, to.shift_v, rise * _most(push.scale_v, push.shift_v, rows))
    if screen_from_panel is not None:
        corners = np.array([[left, top, 1.0], [right, top, 1.0], [left, bottom, 1.0], [right, bottom, 1.0]])
        u, v, w = screen_from_panel @ corners.T
        if min(w) <= 0:  # the part reaches the horizon
            return whole
        left, right, top, bottom = min(u / w), max(u / w), min(v / w), max(v / w)
    u0, v0 = (max(math.floor(edge) - MARGIN_PX, 0) // EVERY_PX * EVERY_PX for edge in (left, top))
    u1, v1 = math.ceil(right) + MARGIN_PX, math.ceil(bottom) + MARGIN_PX
    return PixelRect(u0, v0, min(u1, shown.columns), min(v1, shown.rows))


def limit(shown: ShownPanel, part: PixelRect) -> None:
    """Change arguments to draw only part of the screen, as in the whole, without the flat picture."""
    u, v = part.u0, part.v0
    shown.screen += v * shown.screen_stride + 4 * u
    shown.columns, shown.rows = part.width_px, part.height_px
    if shown.registered:
        h = shown.panel_from_screen
        for row in (0, 3, 6):
            h[row + 2] += h[row] * u + h[row + 1] * v
    else:
        _move(shown.source_from_panel, u, v)
        _move(shown.push, u, v)
        _move(shown.relief_from_screen, u, v)


def _reached(first: int, end: int, scale: float, shift: float, push: float) -> tuple[float, float]:
    """Return where, on the panel, pixels first..end of the source contribute, if they are displaced by up to `push`."""
    return (first - MARGIN_PX - push - shift) / scale, (end + MARGIN_PX + push - shift) / scale


def _most(scale: float, shift: float, size_px: int) -> float:
    """Return the largest displacement by a relief of 1."""
    return max(abs(shift), abs(scale * size_px + shift))


def _move(to: ScaleShift, u: int, v: int) -> None:
    to.shift_u += to.scale_u * u
    to.shift_v += to.scale_v * v
