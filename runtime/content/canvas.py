"""Offscreen targets for sources, kept per size, with smoothed edges, RGBA8."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.content.base import WHITE, ContentInfo, ContentSource, View
from runtime.optics.rect import PixelRect
from runtime.records import F32, U8
from runtime.support.background import raise_if_abandoned
from runtime.support.gl import DrawnPicture

SIDES = 2
SIZES_KEPT = 8


@dataclass(slots=True)
class _Target:
    smooth: Any  # framebuffer with several samples or half floats; None where neither is needed
    plain: list[Any]  # one a side
    pictures: list[U8]  # one (h, w, 4) array a side, reused


class CanvasSource(ContentSource):
    """A source that draws with OpenGL into a framebuffer per view size, read back on request.

    Only the box that the content may touch is cleared, drawn and resolved with several samples a pixel: on a
    software rasteriser resolving is the dearest step.
    """

    def __init__(self, context: Any, *, info: ContentInfo, samples: int = 0, deep: bool = False) -> None:
        """samples: a pixel; deep: draw in half floats, for sums of many layers, some brighter than white."""
        self.info, self.context = info, context
        self.draws_in = context
        self.held: list[Any] = []  # GL objects that are released with it
        self._deep = deep
        self._samples = min(samples, context.max_samples)
        self._clear_colour = (*(info.background or WHITE), 0.0)
        self._targets: dict[tuple[int, int], _Target] = {}
        self._bounds: list[tuple[float, float] | None] = [None] * SIDES  # near and far of each side's newest picture

    @abstractmethod
    def draw(self, view: View, *, time_ns: int) -> DrawnPicture: ...

    def render(self, view: View, *, time_ns: int) -> U8:
        return self.draw(view, time_ns=time_ns).pixels()

    def drawn(self, view: View, box: PixelRect, paint: Callable[[], None]) -> DrawnPicture:
        """Clear, let `paint` draw inside `box`; the picture of the view's side, valid until its next one."""
        raise_if_abandoned()
        self._bounds[view.side] = None
        target = self._target(view.width_px, view.height_px)
        plain = target.plain[view.side]
        plain.use()
        plain.clear(*self._clear_colour, depth=1.0)
        area = (box.u0, box.v0, box.width_px, box.height_px)
        if box.width_px and box.height_px:
            drawn = target.smooth or plain
            if drawn is not plain:
                drawn.use()
                drawn.clear(*self._clear_colour, depth=1.0, viewport=area)
            drawn.scissor = area
            drawn.use()
            paint()
            drawn.scissor = None
            if drawn is not plain:
                plain.scissor = area
                plain.use()
                self.context.copy_framebuffer(plain, drawn)
                plain.scissor = None
        return DrawnPicture(plain.color_attachments[0], plain, target.pictures[view.side])

    def nearness(self, view: View) -> F32 | None:
        bounds, target = self._bounds[view.side], self._targets.get((view.width_px, view.height_px))
        if bounds is None or target is None:
            return None
        near_m, far_m = bounds
        read = target.plain[view.side].read(components=1, attachment=-1, dtype="f4")
        depth = np.frombuffer(read, np.float32).reshape(view.height_px, view.width_px)
        # Between the near and the far plane, depth is linear in the inverse of the distance.
        found = depth * np.float32(1 / far_m - 1 / near_m)
        found += np.float32(1 / near_m)
        found[depth >= 1.0] = 0.0
        return found

    def close(self) -> None:
        while self._targets:
            self._forget_oldest()
        while self.held:
            self.held.pop().release()

    def _forget_oldest(self) -> None:
        target = self._targets.pop(next(iter(self._targets)))
        # moderngl binds the last framebuffer again on later calls: a released one must not be current.
        self.context.detect_framebuffer(0).use()
        for framebuffer in (*target.plain, *([target.smooth] if target.smooth else [])):
            for attachment in (*framebuffer.color_attachments, framebuffer.depth_attachment):
                attachment.release()
            framebuffer.release()

    def _target(self, width_px: int, height_px: int) -> _Target:
        size = (width_px, height_px)
        if size not in self._targets:
            if len(self._targets) >= SIZES_KEPT:
                self._forget_oldest()
            plain = [self._framebuffer(size, self.context.texture(size, 4)) for _ in range(SIDES)]
            smooth = None
            if self._samples > 1 or self._deep:
                dtype = "f2" if self._deep else "f1"
                samples = self._samples
                smooth = self._framebuffer(
                    size, self.context.renderbuffer(size, 4, samples=samples, dtype=dtype), samples=samples
                )
            pictures = [np.zeros((height_px, width_px, 4), np.uint8) for _ in range(SIDES)]
            self._targets[size] = _Target(smooth, plain, pictures)
        return self._targets[size]

    def _framebuffer(self, size: tuple[int, int], colour: Any, *, samples: int = 0) -> Any:
        # Depth in a texture: Mesa never frees a renderbuffer's where another context of the group releases it.
        return self.context.framebuffer([colour], self.context.depth_texture(size, samples=samples))
