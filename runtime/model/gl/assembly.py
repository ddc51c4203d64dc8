"""Layers of whole panels put together where they lie: in textures that a context which shows them shares."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.model.assembly import ArrayAssembly, Placed, Rest, Shared, centre_codes
from runtime.model.gl.programs import Image, Passes
from runtime.model.reprojection import NEUTRAL
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import U8, Layers
from runtime.support.gl import DrawnPicture
from runtime.support.gl_sharing import LayerPool, LayerTextures, wait_until_drawn

NAMES = ("rear", "centre", "front")
NOWHERE = PixelRect(0, 0, 0, 0)


class GlAssembly:
    """An `Assembly` that draws. Layers that come as arrays are put together on the processor."""

    def __init__(self, passes: Passes, pool: LayerPool, stack: PanelStack) -> None:
        """pool: where layers are left, and where those come from that are put together."""
        self._passes, self._pool, self._stack = passes, pool, stack
        self._arrays = ArrayAssembly(stack)
        self._transposed: dict[int, DrawnPicture] = {}  # an eye
        self._textures: dict[str, Any] = {}  # made when they are first needed, on the thread that draws

    def assembled(self, rest: Rest, window: Placed | None) -> Layers:
        layers = None if window is None else window.layers
        if layers is not None and not isinstance(layers, LayerTextures):
            return self._arrays.assembled(rest, window)
        with self._passes.drawing():
            inputs = {} if layers is None else _images(layers)
            places: dict[str, Any] = {
                "window": _corners(NOWHERE if window is None else window.box),
                "kept": _corners(NOWHERE if window is None else window.kept),
                "even": float(NEUTRAL),
                "pictured": isinstance(rest, Shared),
            }
            codes = centre_codes(self._stack.count)
            if isinstance(rest, Shared):
                picture = self._taken(rest.picture)
                inputs |= {"picture": picture, "codes": self._table(codes)}
                places |= {"origin": (0, 0), "box": picture.size, "emphasis": rest.emphasis}
            else:
                places["colour"] = tuple(map(float, codes[list(rest.colour)]))
            left = self._left()
            self._passes.draw("assemble", tuple(_images(left).values()), inputs, places)
            wait_until_drawn()
        return left

    def transposed_picture(self, picture: U8 | DrawnPicture, side: int) -> U8 | DrawnPicture:
        if not isinstance(picture, DrawnPicture):
            return self._arrays.transposed_picture(picture, side)
        width, height = self._stack.height_px, self._stack.width_px
        with self._passes.drawing():
            if side not in self._transposed:
                texture = self._textures[f"transposed {side}"] = self._passes.context.texture((width, height), 4)
                target = self._passes.target((Image(texture, width, height),))
                self._transposed[side] = DrawnPicture(texture, target, np.empty((height, width, 4), np.uint8))
            transposed = self._transposed[side]
            self._transpose(picture.texture, transposed.texture)
        return replace(transposed, grey=picture.grey)

    def transposed(self, layers: Layers) -> Layers:
        if not isinstance(layers, LayerTextures):
            return self._arrays.transposed(layers)
        with self._passes.drawing():
            left = self._left()
            for texture, transposed in zip(layers.textures, left.textures, strict=True):
                self._transpose(texture, transposed)
            wait_until_drawn()
        return left

    def close(self) -> None:
        with suppress(Exception):  # of a context that is lost there is nothing to release
            for texture in self._textures.values():
                self._passes.forget(texture)
        self._textures, self._transposed = {}, {}

    def _transpose(self, texture: Any, transposed: Any) -> None:
        self._passes.draw(
            "transpose", (Image(transposed, *transposed.size),), {"image": Image(texture, *texture.size)}, {}
        )

    def _left(self) -> LayerTextures:
        return left_in(self._pool, self._passes, self._stack)

    def _taken(self, picture: U8) -> Image:
        """A picture of the whole centre panel, uploaded."""
        width, height = self._stack.width_px, self._stack.height_px
        if "picture" not in self._textures:
            self._textures["picture"] = self._passes.context.texture((width, height), 4)
        texture = self._textures["picture"]
        texture.write(np.ascontiguousarray(picture))
        return Image(texture, width, height)

    def _table(self, codes: U8) -> Image:
        if "codes" not in self._textures:
            self._textures["codes"] = self._passes.context.texture((len(codes), 1), 1, codes)
        return Image(self._textures["codes"], len(codes), 1)


def left_in(pool: LayerPool, passes: Passes, stack: PanelStack) -> LayerTextures:
    """Textures for a stack's layers to be left in; those of sizes that nobody asks for any more are released."""
    left = pool.taken(stack.count, width_px=stack.width_px, height_px=stack.height_px)
    for textures in pool.surplus():
        for texture in textures:
            passes.forget(texture)
    return left


def _images(layers: LayerTextures) -> dict[str, Image]:
    return {name: Image(texture, *texture.size) for name, texture in zip(NAMES, layers.textures, strict=True)}


def _corners(area: PixelRect) -> tuple[int, int, int, int]:
    return area.u0, area.v0, area.u1, area.v1
