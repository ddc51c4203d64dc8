"""Where sources draw: offscreen targets that are kept per size, smoothed edges, RGBA8 read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.optics.rect import PixelRect
from runtime.records import U8
from runtime.support.gl import finish

SIDES = 2
SIZES_KEPT = 8


@dataclass(slots=True)
class _Target:
    smooth: Any  # framebuffer with several samples or half floats; `plain` where neither is wanted
    plain: Any
    pictures: list[U8]  # one (h, w, 4) array a side, reused


class Canvas:
    """Draws into an offscreen framebuffer of a view's size and reads it back.

    Only the box that the content may touch is cleared, drawn and resolved with several samples a pixel: on a
    software rasteriser resolving is the dearest step.
    """

    def __init__(
        self, context: Any, *, samples: int, background: tuple[float, float, float], deep: bool = False
    ) -> None:
        """deep: draw in half floats, for sums of many layers, some brighter than white."""
        self._context = context
        self._deep = deep
        self._samples = min(samples, context.max_samples)
        self.clear_colour = (*background, 0.0)
        self._targets: dict[tuple[int, int], _Target] = {}

    def draw(self, *, width_px: int, height_px: int, side: int, box: PixelRect, paint: Callable[[], None]) -> U8:
        """Clear, let `paint` issue its draw calls inside `box`, and return the (h, w, 4) picture of that side."""
        target = self._target(width_px, height_px)
        target.plain.use()
        target.plain.clear(*self.clear_colour, depth=1.0)
        area = (box.u0, box.v0, box.width_px, box.height_px)
        if box.width_px and box.height_px:
            if target.smooth is not target.plain:
                target.smooth.use()
                target.smooth.clear(*self.clear_colour, depth=1.0, viewport=area)
            target.smooth.scissor = area
            target.smooth.use()
            paint()
            target.smooth.scissor = None
            if target.smooth is not target.plain:
                target.plain.scissor = area
                target.plain.use()
                self._context.copy_framebuffer(target.plain, target.smooth)
                target.plain.scissor = None
        finish()
        picture = target.pictures[side]
        target.plain.read_into(picture, components=4)
        return picture

    def close(self) -> None:
        """Release every framebuffer. May be called twice."""
        while self._targets:
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        target = self._targets.pop(next(iter(self._targets)))
        # moderngl binds the last framebuffer again on later calls: it must not be one that is no more.
        self._context.detect_framebuffer(0).use()
        for framebuffer in {id(f): f for f in (target.smooth, target.plain)}.values():
            for attachment in (*framebuffer.color_attachments, framebuffer.depth_attachment):
                attachment.release()
            framebuffer.release()

    def _target(self, width_px: int, height_px: int) -> _Target:
        size = (width_px, height_px)
        if size not in self._targets:
            if len(self._targets) >= SIZES_KEPT:
                self._forget_oldest()
            plain = self._framebuffer(size, 0)
            other = self._samples > 1 or self._deep
            smooth = self._framebuffer(size, self._samples, "f2" if self._deep else "f1") if other else plain
            pictures = [np.zeros((height_px, width_px, 4), np.uint8) for _ in range(SIDES)]
            self._targets[size] = _Target(smooth, plain, pictures)
        return self._targets[size]

    def _framebuffer(self, size: tuple[int, int], samples: int, dtype: str = "f1") -> Any:
        colour = self._context.renderbuffer(size, 4, samples=samples, dtype=dtype)
        return self._context.framebuffer([colour], self._context.depth_renderbuffer(size, samples=samples))
