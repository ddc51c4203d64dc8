"""Antialiased offscreen RGBA8 framebuffers for sources that draw with OpenGL."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np

from runtime.content.base import WHITE, ContentInfo, ContentSource, View
from runtime.optics.rect import PixelRect
from runtime.records import F32, U8
from runtime.support.gl import DrawnPicture, set_uniforms

SIDES = 2
WHOLE = """#version 330
void main() { gl_Position = vec4(vec2((gl_VertexID << 1) & 2, gl_VertexID & 2) * 2.0 - 1.0, 0.0, 1.0); }
"""
NEAREST = """#version 330
#ifdef GL_ARB_texture_gather
#extension GL_ARB_texture_gather : enable
#endif
uniform sampler2D depth;
uniform int every;
uniform ivec2 first;
uniform float at_near;
uniform float at_far;
out float nearness;
void main() {
    ivec2 begin = ivec2(gl_FragCoord.xy) * every - first, last = textureSize(depth, 0) - 1;
    float nearest = 1.0;
#ifdef GL_ARB_texture_gather
    if (every % 2 == 0) {
        vec4 four = vec4(1.0);
        for (int j = 1; j < every; j += 2)
            for (int i = 1; i < every; i += 2)
                four = min(four, textureGather(depth, vec2(begin + ivec2(i, j)) / vec2(last + 1)));
        nearest = min(min(four.x, four.y), min(four.z, four.w));
    } else
#endif
    for (int j = 0; j < every; j++)
        for (int i = 0; i < every; i++)
            nearest = min(nearest, texelFetch(depth, clamp(begin + ivec2(i, j), ivec2(0), last), 0).r);
    nearness = nearest < 1.0 ? mix(at_near, at_far, nearest) : 0.0;
}
"""
SIZES_KEPT = 8
OVER = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)


@dataclass(slots=True)
class _Target:
    smooth: Any  # multisampled or half-float framebuffer, or None if the plain ones suffice
    plain: list[Any]  # RGBA8 framebuffers, one per side
    pictures: list[U8]  # arrays (h, w, 4) that pixels are read back into, one per side


class _Reducer:
    """Reduces a depth buffer on the GPU, which is faster than reading back all of it."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._program = context.program(vertex_shader=WHOLE, fragment_shader=NEAREST)
        self._array = context.vertex_array(self._program, [])
        self._targets: dict[tuple[int, int], Any] = {}

    def reduced(
        self, depth: Any, size: tuple[int, int], *, every: int, first: tuple[int, int], at_near: float, at_far: float
    ) -> F32:
        """Return values (rows, columns) linear in the smallest depth of each block, from `at_near` to
        `at_far`, 0 if empty. `size` is in blocks; `every` and `first` are those of `ContentSource.nearness`.
        """
        if size not in self._targets:
            if len(self._targets) >= SIZES_KEPT:
                self._drop(next(iter(self._targets)))
            self._targets[size] = self._context.framebuffer([self._context.texture(size, 1, dtype="f4")])
        target = self._targets[size]
        self._context.enable_only(self._context.NOTHING)
        target.use()
        depth.compare_func = ""
        depth.use(0)
        set_uniforms(self._program, {"every": every, "first": first, "at_near": at_near, "at_far": at_far})
        self._array.render(self._context.TRIANGLES, vertices=3)
        found = np.frombuffer(target.read(components=1, dtype="f4"), np.float32)
        return found.reshape(size[1], size[0])

    def release(self) -> None:
        while self._targets:
            self._drop(next(iter(self._targets)))
        self._array.release()
        self._program.release()

    def _drop(self, size: tuple[int, int]) -> None:
        target = self._targets.pop(size)
        self._context.detect_framebuffer(0).use()
        target.color_attachments[0].release()
        target.release()


class CanvasSource(ContentSource):
    """Base class for sources that draw with OpenGL into one framebuffer per view size. Only the box that
    the content may cover is drawn and has its multiple samples resolved, because resolving is the most expensive step
    on a software rasteriser. Pixels are read back only on request.
    """

    def __init__(self, context: Any, *, info: ContentInfo, samples: int = 0, deep: bool = False) -> None:
        """Create the source; 0 `samples` for no multisampling, `deep` for half floats (brighter than white)."""
        self.info, self.context = info, context
        self.draws_in = context
        self.held: list[Any] = []  # GL objects released together with the source
        self._deep = deep
        self._samples = min(samples, context.max_samples)
        self._clear_colour = (*(info.background or WHITE), 0.0)
        self._targets: dict[tuple[int, int], _Target] = {}
        self._reducer: _Reducer | None = None
        self._bounds: list[tuple[float, float] | None] = [None] * SIDES  # near and far planes of each side's picture

    @abstractmethod
    def draw(self, view: View, *, time_ns: int) -> DrawnPicture: ...

    def render(self, view: View, *, time_ns: int) -> U8:
        return self.draw(view, time_ns=time_ns).pixels()

    def drawn(self, view: View, box: PixelRect, paint: Callable[[], None]) -> DrawnPicture:
        """Clear a view's framebuffer, call `paint` to draw inside `box`, and return the picture."""
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

    def nearness(self, view: View, *, every: int, first: tuple[int, int]) -> F32 | None:
        bounds, target = self._bounds[view.side], self._targets.get((view.width_px, view.height_px))
        if bounds is None or target is None:
            return None
        near_m, far_m = bounds
        if self._reducer is None:
            self._reducer = _Reducer(self.context)
        size = -(-(view.width_px + first[0]) // every), -(-(view.height_px + first[1]) // every)
        depth = target.plain[view.side].depth_attachment
        # Between the near and far planes, depth is linear in the inverse distance.
        return self._reducer.reduced(
            depth, size, every=every, first=first, at_near=1 / near_m, at_far=1 / far_m
        )  # fmt: skip

    def close(self) -> None:
        while self._targets:
            self._forget_oldest()
        if self._reducer is not None:
            self._reducer.release()
            self._reducer = None
        while self.held:
            self.held.pop().release()

    def _forget_oldest(self) -> None:
        target = self._targets.pop(next(iter(self._targets)))
        # Later calls to moderngl bind the current framebuffer again, so it must not be one that has been released.
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
        # The depth buffer is a texture because Mesa leaks a renderbuffer that is released by a context sharing it.
        depth = self.context.depth_texture(size, samples=samples)
        if not samples:
            depth.repeat_x = depth.repeat_y = False
        return self.context.framebuffer([colour], depth)
