"""Layers of whole panels from what was solved: a window among the rest, rows for columns, where the layers lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from runtime.model.reprojection import NEUTRAL
from runtime.model.targets import SUBCODE, phase_codes, pre_emphasised
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import U8, Layers, pixels_of
from runtime.support.gl import DrawnPicture
from runtime.support.threads import PIECE_ROWS, at_once


@dataclass(frozen=True, slots=True)
class Uniform:
    """Both eyes see one colour."""

    colour: tuple[int, ...]  # red, green, blue in 8-bit codes


@dataclass(frozen=True, slots=True)
class Shared:
    """Both eyes see one picture."""

    picture: U8  # (h, w, 4) RGBA of the whole centre panel
    emphasis: float  # how strongly it is sharpened (`targets.pre_emphasised`)


Rest = Uniform | Shared  # beside a window: the outer panels are even, the centre panel carries it


@dataclass(frozen=True, slots=True)
class Placed:
    """What was solved of a window, and where it belongs: pixels of the whole panels."""

    layers: Layers  # (N, h, w, 4) of the box
    box: PixelRect  # of every panel
    kept: PixelRect  # of the centre panel, within the box: beside it that panel belongs to the rest


class Assembly(Protocol):
    """Puts layers of whole panels together. State lives from frame to frame; one thread uses it."""

    def assembled(self, rest: Rest, window: Placed | None) -> Layers:
        """(N, h, w, 4): a window, if any, among the rest; an array is the assembly's own until the next frame."""

    def transposed_picture(self, picture: U8 | DrawnPicture, side: int) -> U8 | DrawnPicture:
        """(w, h, 4): an eye's picture of the whole centre panel with rows for columns, until the next of its side."""

    def transposed(self, layers: Layers) -> Layers:
        """(N, h, w, 4): layers (N, w, h, 4) of transposed panels with rows for columns; an array is the assembly's own
        until the next frame."""

    def close(self) -> None:
        """Release textures. May be called twice."""


class ArrayAssembly:
    """An `Assembly` on the processor, which writes only what changes from frame to frame."""

    def __init__(self, stack: PanelStack) -> None:
        self._stack = stack
        self._layers: U8 | None = None  # assembled
        self._transposed: U8 | None = None
        self._solved: PixelRect | None = None  # where the outer panels are not even
        self._colour: tuple[int, ...] | None = None  # that fills the centre panel beside the window

    def assembled(self, rest: Rest, window: Placed | None) -> U8:
        if self._layers is None:
            self._layers = self._empty(255)
            self._layers[..., :3] = NEUTRAL
        layers = self._layers
        self._even_out(layers, but=None if window is None else window.box)
        if isinstance(rest, Uniform):
            self._paint(layers, rest.colour)
        else:
            self._fill_with(layers, rest, but=None if window is None else window.kept)
        if window is not None:
            self._place(layers, window)
        return layers

    def transposed_picture(self, picture: U8 | DrawnPicture, side: int) -> U8:
        pixels = picture.pixels() if isinstance(picture, DrawnPicture) else picture
        return np.asarray(cv2.transpose(pixels), np.uint8)

    def transposed(self, layers: Layers) -> U8:
        if self._transposed is None:
            self._transposed = self._empty(0)
        for layer, out in zip(pixels_of(layers), self._transposed, strict=True):
            cv2.transpose(layer, dst=out)
        return self._transposed

    def close(self) -> None:
        """It holds nothing."""

    def _empty(self, code: int) -> U8:
        return np.full((self._stack.count, self._stack.height_px, self._stack.width_px, 4), code, np.uint8)

    def _even_out(self, layers: U8, *, but: PixelRect | None) -> None:
        """Bring the outer panels back to the middle of their range where the last frame drove them."""
        if self._solved is None or self._solved == but:
            return
        for layer in layers:
            fill_area(layer, self._solved, (NEUTRAL, NEUTRAL, NEUTRAL))
        self._solved, self._colour = None, None

    def _paint(self, layers: U8, colour: tuple[int, ...]) -> None:
        """The centre panel as if both eyes saw nothing but a colour; once, as long as nothing changes."""
        codes = centre_codes(self._stack.count)[list(colour)].tolist()
        layer = layers[self._stack.count // 2]
        if self._colour != colour:
            fill_area(layer, PixelRect(0, 0, self._stack.width_px, self._stack.height_px), codes)
            self._colour = colour
        elif self._solved is not None:
            fill_area(layer, self._solved, codes)

    def _fill_with(self, layers: U8, rest: Shared, *, but: PixelRect | None) -> None:
        """The picture on the centre panel, as both eyes see it where they agree."""
        self._colour = None
        centre, codes = layers[self._stack.count // 2], centre_codes(self._stack.count)

        def fill(part: PixelRect) -> None:
            grown = PixelRect(max(0, part.u0 - 1), max(0, part.v0 - 1), part.u1 + 1, part.v1 + 1)
            sharp = pre_emphasised(rest.picture[grown.slices], rest.emphasis)
            rows = slice(part.v0 - grown.v0, part.v1 - grown.v0)
            columns = slice(part.u0 - grown.u0, part.u1 - grown.u0)
            cv2.LUT(sharp[rows, columns], codes, dst=centre[part.slices])

        hole = but or PixelRect(0, 0, 0, 0)
        parts = hole.beside(width_px=self._stack.width_px, height_px=self._stack.height_px)
        at_once(fill, [piece for part in parts for piece in part.in_rows(PIECE_ROWS)])

    def _place(self, layers: U8, window: Placed) -> None:
        """The window's layers among the rest."""
        area = window.box

        def place(item: tuple[int, U8, U8]) -> None:
            index, layer, part = item
            kept = window.kept if index == self._stack.count // 2 else area
            rows, columns = slice(kept.v0 - area.v0, kept.v1 - area.v0), slice(kept.u0 - area.u0, kept.u1 - area.u0)
            layer[kept.v0 : kept.v1, kept.u0 : kept.u1] = part[rows, columns]

        at_once(place, list(zip(range(len(layers)), layers, pixels_of(window.layers), strict=True)))
        self._solved = area


def centre_codes(panels: int) -> U8:
    """(256,) the centre panel's code for each code of the picture, the others standing at NEUTRAL."""
    phases = phase_codes(2).reshape(256, -1)[:, 0].astype(np.int32)
    return np.clip((phases - (panels - 1) * NEUTRAL * SUBCODE + SUBCODE // 2) // SUBCODE, 0, 255).astype(np.uint8)


def fill_area(layer: U8, area: PixelRect, codes: Sequence[int]) -> None:
    """One colour in a part of an RGBA layer; whole pixels at a time, which is many times as fast as bytes."""
    pixel = np.array([*codes, 255], np.uint8).view(np.uint32)
    layer.view(np.uint32)[area.v0 : area.v1, area.u0 : area.u1, 0] = pixel


def flat_layers(image: U8, stack: PanelStack) -> U8:
    """(N, h, w, 4) layers that show a picture (h, w, 4), drawn on the middle panel's raster, to every eye."""
    middle = stack.count // 2
    layers = np.full((stack.count, stack.height_px, stack.width_px, 4), 255, np.uint8)
    # On the second branch the sum is at least one panel's range: the other panels share it, and the middle
    # one carries the picture.
    even = 255 // (stack.count - 1)
    layers[..., :3] = even
    phase = cv2.LUT(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), phase_codes(2))
    rest = np.clip((phase + SUBCODE // 2) // SUBCODE - even * (stack.count - 1), 0, 255).astype(np.uint8)
    layers[middle, ..., :3] = rest
    return layers
