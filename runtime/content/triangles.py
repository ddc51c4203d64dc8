"""Triangles with colours, pictures and one lamp, drawn straight into the pixels that a view asks for.

A part pays only for what it has: without lamp, picture, vertex colours or holes its shader has none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np

from runtime.content import camera
from runtime.content.base import ContentInfo, View
from runtime.content.canvas import CanvasSource
from runtime.content.fringe import edges_of, ramps, silhouette
from runtime.content.shapes import I32, Shape
from runtime.optics.rect import PixelRect, union
from runtime.records import F32, F64, U8
from runtime.support.background import raise_if_abandoned
from runtime.support.gl import DrawnPicture

OUTLINED_MAX = 200_000  # triangles of a part; beyond, finding its outline costs more than drawing it
PROJECTED_MAX = 5000  # vertices of a part that are projected to see where it lies; beyond, its box is
DRAWN_AT_ONCE = 20_000  # triangles
UPLOADED_AT_ONCE = 8 << 20  # bytes
OUTLINE_BYTES = 6 * (5 + 8) * 4  # two triangles an edge: clip coordinates and coverage, then the attributes
OVER = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)

VERTEX = """
#ifdef OUTLINE
in vec4 in_clip;
in float in_coverage;
#else
uniform mat4 clip_from_part;
in vec3 in_position;
#endif
in vec3 in_normal;
in vec2 in_uv;
in vec3 in_colour;
uniform mat3 stack_from_part;
uniform vec3 colour;
out vec2 uv;
out vec3 shade;
out float coverage;
const vec3 TO_LAMP = vec3(0.66, -0.36, 0.66);
void main() {
    shade = colour;
#ifdef COLOURED
    shade *= in_colour;
#endif
#ifdef LIT
    vec3 normal = stack_from_part * in_normal;
    float lamp = 0.5 + 0.5 * dot(normal, TO_LAMP) / max(length(normal), 1e-6);
    shade *= 0.38 + 0.62 * lamp;
#endif
    uv = in_uv;
#ifdef OUTLINE
    coverage = in_coverage;
    gl_Position = in_clip;
#else
    coverage = 1.0;
    gl_Position = clip_from_part * vec4(in_position, 1.0);
#endif
}
"""
FRAGMENT = """
in vec2 uv;
in vec3 shade;
in float coverage;
out vec4 pixel;
uniform sampler2D picture;
void main() {
    vec3 rgb = shade;
#ifdef PICTURE
    vec4 texel = texture(picture, uv);
    rgb *= texel.rgb;
#ifdef HOLES
    if (texel.a < 0.5) discard;
#endif
#endif
#ifdef GREY
    rgb = vec3(dot(rgb, vec3(0.299, 0.587, 0.114)));
#endif
    pixel = vec4(rgb, coverage);
}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Triangles of one material, in their own frame."""

    shape: Shape
    picture: U8 | None = None  # (h, w, 4) RGBA, row 0 at uv 0; parts may share one array
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)  # multiplies everything, 0-1
    vertex_colours: F32 | None = None  # (v, 3), 0-1
    lit: bool = True
    grey: bool = False
    turning: bool = False  # its placement changes: it is boxed for every orientation

    @property
    def features(self) -> tuple[str, ...]:
        """The shader switches that it needs."""
        switches = {
            "LIT": self.lit,
            "PICTURE": self.picture is not None,
            "HOLES": self.picture is not None and bool((self.picture[..., 3] < 128).any()),
            "COLOURED": self.vertex_colours is not None,
            "GREY": self.grey,
        }
        return tuple(name for name, wanted in switches.items() if wanted)


class DrawnPart:
    """A part with its prepared buffers: made on any thread without GL, then uploaded by its source."""

    def __init__(self, part: Part, *, outlined: bool = True) -> None:
        """outlined: with what ramps along its outline need."""
        mesh = part.shape
        self.features, self.picture, self.colour = part.features, part.picture, part.colour
        self.triangles = np.ascontiguousarray(mesh.triangles, np.int32)
        self.corner_count, self.is_projected = self.triangles.size, len(mesh.positions_m) <= PROJECTED_MAX
        # (v, 11) position, normal, texture coordinates, colour
        self.vertices = np.ones((len(mesh.positions_m), 11), np.float32)
        columns = (mesh.positions_m, mesh.normals, mesh.uv, 1.0 if part.vertex_colours is None else part.vertex_colours)
        for (first, end), values in zip(((0, 3), (3, 6), (6, 8), (8, 11)), columns, strict=True):
            self.vertices[:, first:end] = values
        self.edges = edges_of(mesh) if outlined and len(mesh.triangles) <= OUTLINED_MAX else None
        low, high = mesh.positions_m.min(0), mesh.positions_m.max(0)
        if part.turning:
            reach = float(np.linalg.norm(mesh.positions_m, axis=1).max())
            low, high = np.full(3, -reach), np.full(3, reach)
        self.corners_m = camera.box_corners(low, high)  # (8, 3) of the box that holds it; frame of the part
        self.texture: Any = None

    @property
    def positions(self) -> F32:
        """(v, 3) at present."""
        return self.vertices[:, :3]

    def upload(self, context: Any, surface_program: Any, outline_program: Any, texture: Any) -> None:
        """Make its GL objects; programs and texture are the source's, and shared."""
        self.surface_program, self.outline_program, self.texture = surface_program, outline_program, texture
        self._buffer, self._triangles = (_uploaded(context, array) for array in (self.vertices, self.triangles))
        if self.edges is None and not self.is_projected:  # hundreds of MiB that nobody looks at any more
            self.vertices, self.triangles = self.vertices[:0].copy(), self.triangles[:0].copy()
        names = ("in_normal", "in_uv", "in_colour")
        layout = _layout(surface_program, self._buffer, ("in_position", *names), (3, 3, 2, 3))
        self.surface = context.vertex_array(surface_program, [layout], index_buffer=self._triangles)
        size = max(len(self.edges.faces) if self.edges else 0, 1) * OUTLINE_BYTES
        self._outline_buffer = context.buffer(reserve=size, dynamic=True)
        layout = _layout(outline_program, self._outline_buffer, ("in_clip", "in_coverage", *names), (4, 1, 3, 2, 3))
        self._outline = context.vertex_array(outline_program, [layout])

    def draw_surface(self) -> None:
        """In pieces: a software rasteriser holds Python's lock for as long as a call takes."""
        for first in range(0, self.corner_count, 3 * DRAWN_AT_ONCE):
            raise_if_abandoned()
            self.surface.render(first=first, vertices=min(3 * DRAWN_AT_ONCE, self.corner_count - first))

    def draw_outline(self, corners: F32, vertices: I32) -> None:
        """Ramps (k, 6, 5) along its outline, each corner with the attributes of a vertex (k, 6)."""
        packed = np.concatenate([corners.reshape(-1, 5), self.vertices[vertices.reshape(-1), 3:]], axis=1)
        self._outline_buffer.write(packed)
        self._outline.render(vertices=len(packed))

    def release(self) -> None:
        """Its GL objects, but for what is shared; a vertex array does not release its buffers."""
        for held in (self.surface, self._buffer, self._triangles, self._outline, self._outline_buffer):
            held.release()


class TriangleSource(CanvasSource):
    """Parts at their places, over a background."""

    def __init__(
        self,
        parts: Sequence[DrawnPart],
        stack_from_parts: Sequence[F64],
        *,
        context: Any,
        info: ContentInfo,
        samples: int = 0,
    ) -> None:
        """stack_from_parts: 4x4 similarities; samples: per pixel for outlines; 0: ramps along the outlines.

        A software rasteriser draws ramps faster.
        """
        super().__init__(context, info=info, samples=samples)
        self.parts, self.stack_from_parts = list(parts), list(stack_from_parts)
        self._with_ramps = samples == 0
        self._programs: dict[tuple[str, ...], Any] = {}
        self._textures: dict[int, Any] = {}
        for part in self.parts:
            programs = self._program(part.features), self._program((*part.features, "OUTLINE"))
            picture = part.picture
            part.upload(context, *programs, None if picture is None else self._texture(picture))
        self.held += [*self.parts, *self._textures.values(), *self._programs.values()]

    def places(self, time_ns: int) -> Sequence[F64]:
        """4x4 stack_from_part of every part, which what moves works out anew."""
        return self.stack_from_parts

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        boxes = []
        for part, matrix in zip(self.parts, self.places(time_ns), strict=True):
            points = part.positions.astype(np.float64) if part.is_projected else part.corners_m
            boxes.append(camera.covered_box(view, points @ matrix[:3, :3].T + matrix[:3, 3], align_px=1))
        return union(boxes)

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        """Draw the view; the same view and time give the same bytes."""
        placed = list(zip(self.parts, self.places(time_ns), strict=True))
        corners = np.stack([part.corners_m @ matrix[:3, :3].T + matrix[:3, 3] for part, matrix in placed])
        area = union([camera.covered_box(view, part) for part in corners])
        # Nearest first: what they hide need not be shaded.
        placed = [placed[index] for index in np.argsort(-corners[..., 0].mean(1), kind="stable")]

        def paint() -> None:
            clip = camera.clip_from_stack(view, corners.reshape(-1, 3))
            self.context.enable_only(self.context.DEPTH_TEST)
            for part, stack_from_part in placed:
                _set_look(part.surface_program, part, stack_from_part, view)
                part.surface_program["clip_from_part"].write(_gl(clip @ stack_from_part))
                part.draw_surface()
            if self._with_ramps:
                self._draw_outlines(placed, clip, view)

        return self.drawn(view, area, paint)

    def _program(self, features: tuple[str, ...]) -> Any:
        if features not in self._programs:
            raise_if_abandoned()
            head = "#version 330\n" + "".join(f"#define {name}\n" for name in features)
            shaders = {"vertex_shader": head + VERTEX, "fragment_shader": head + FRAGMENT}
            self._programs[features] = self.context.program(**shaders)
        return self._programs[features]

    def _texture(self, picture: U8) -> Any:
        if id(picture) not in self._textures:
            height, width = picture.shape[:2]
            texture = self.context.texture((width, height), 4, np.ascontiguousarray(picture).tobytes())
            texture.build_mipmaps()
            texture.filter = (self.context.LINEAR_MIPMAP_NEAREST, self.context.LINEAR)
            self._textures[id(picture)] = texture
        return self._textures[id(picture)]

    def _draw_outlines(self, placed: list[tuple[DrawnPart, F64]], clip_from_stack: F64, view: View) -> None:
        context, framebuffer = self.context, self.context.fbo
        context.enable_only(context.DEPTH_TEST | context.BLEND)
        context.blend_func = OVER
        framebuffer.depth_mask = False
        for part, stack_from_part in reversed(placed):
            if part.edges is None or not np.linalg.det(stack_from_part[:3, :3]):
                continue  # nor where it was squashed: then it has no inside
            eye = np.linalg.solve(stack_from_part, np.append(view.eye_m, 1.0))[:3]
            ends, apex = silhouette(part.edges, eye)
            clip_from_part = clip_from_stack @ stack_from_part
            clip = part.positions @ clip_from_part[:, :3].T + clip_from_part[:, 3]
            corners, vertices = ramps(clip, ends, apex, width_px=view.width_px, height_px=view.height_px)
            if len(corners):
                _set_look(part.outline_program, part, stack_from_part, view)
                part.draw_outline(corners, vertices)
        framebuffer.depth_mask = True


def _set_look(program: Any, part: DrawnPart, stack_from_part: F64, view: View) -> None:
    linear = stack_from_part[:3, :3]
    if view.display_from_view is not None:
        linear = view.display_from_view @ linear
    if "stack_from_part" in program:
        program["stack_from_part"].write(_gl(np.linalg.pinv(linear).T * np.cbrt(abs(np.linalg.det(linear)))))
    program["colour"] = part.colour
    if part.texture is not None:
        part.texture.use(0)


def _uploaded(context: Any, array: Any) -> Any:
    """A buffer, in pieces: uploading holds Python's lock."""
    data = memoryview(array).cast("B")
    buffer = context.buffer(reserve=data.nbytes)
    for first in range(0, data.nbytes, UPLOADED_AT_ONCE):
        buffer.write(data[first : first + UPLOADED_AT_ONCE], offset=first)
    return buffer


def _gl(matrix: F64) -> F32:
    """Column by column, as GL reads a matrix."""
    return np.ascontiguousarray(matrix.T, np.float32)


def _layout(program: Any, buffer: Any, names: tuple[str, ...], sizes: tuple[int, ...]) -> tuple[Any, ...]:
    """A buffer's description for a program; what the compiler left out is skipped."""
    used = [name for name in names if name in program]
    formats = [f"{size}f" if name in used else f"{size * 4}x" for name, size in zip(names, sizes, strict=True)]
    return (buffer, " ".join(formats), *used)
