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
from runtime.content.base import View
from runtime.content.canvas import Canvas
from runtime.content.fringe import Edges, edges_of, ramps, silhouette
from runtime.content.shapes import Shape
from runtime.optics.rect import PixelRect, union
from runtime.records import F32, F64, U8
from runtime.support.gl import DrawnPicture, linked_program

OUTLINED_MAX = 200_000  # triangles of a part; beyond, finding its outline costs more than drawing it
PROJECTED_MAX = 5000  # vertices of a part that are projected to see where it lies; beyond, its box is
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


@dataclass(frozen=True, slots=True, eq=False)
class ReadyPart:
    """A part with all that can be worked out without a GL context: the slow half of getting it on to the panels."""

    part: Part
    features: tuple[str, ...]
    attributes: F32  # (v, 8) normal, texture coordinates, colour
    packed: F32  # (v, 11) position and attributes
    edges: Edges | None  # for ramps along the outline; None: it has none
    corners_m: F64  # (8, 3) of the box that holds it; frame of the part


def ready(part: Part, *, outlined: bool = True) -> ReadyPart:
    """Needs no GL: may run on any thread. outlined: with what ramps along its outline need."""
    mesh = part.shape
    attributes = _attributes(part)
    low, high = mesh.positions_m.min(0), mesh.positions_m.max(0)
    if part.turning:
        reach = float(np.linalg.norm(mesh.positions_m, axis=1).max())
        low, high = np.full(3, -reach), np.full(3, reach)
    return ReadyPart(
        part=part,
        features=part.features,
        attributes=attributes,
        packed=np.concatenate([mesh.positions_m, attributes], axis=1, dtype=np.float32),
        edges=edges_of(mesh) if outlined and len(mesh.triangles) <= OUTLINED_MAX else None,
        corners_m=camera.box_corners(low, high),
    )


@dataclass(slots=True)
class _Uploaded:
    part: Part
    positions: F32  # (v, 3) at present
    surface: Any
    surface_buffers: tuple[Any, ...]  # vertices, triangles: a vertex array does not release them
    outline: Any
    outline_buffer: Any
    edges: Edges | None
    texture: Any
    surface_program: Any
    outline_program: Any
    corners_m: F64  # (8, 3) of the box that holds it; frame of the part
    attributes: F32  # (v, 8)


class TrianglePainter:
    """Uploads parts once and draws them through any view."""

    def __init__(
        self,
        parts: Sequence[Part | ReadyPart],
        *,
        context: Any,
        background: tuple[float, float, float],
        samples: int = 0,
    ) -> None:
        """samples: per pixel, for outlines; 0: ramps along the outlines, which a software rasteriser draws faster."""
        self._context = context
        self._canvas = Canvas(context, samples=samples, background=background)
        self._with_ramps = samples == 0
        self._programs: dict[tuple[str, ...], Any] = {}
        self._textures: dict[int, Any] = {}
        self._parts = [
            self._upload(part if isinstance(part, ReadyPart) else ready(part, outlined=samples == 0)) for part in parts
        ]

    def corners_m(self, stack_from_parts: Sequence[F64]) -> F64:
        """(8n, 3) corners in the stack frame of the boxes that hold the parts."""
        placed = zip(self._parts, stack_from_parts, strict=True)
        return np.concatenate([item.corners_m @ matrix[:3, :3].T + matrix[:3, 3] for item, matrix in placed])

    def extent(self, view: View, stack_from_parts: Sequence[F64]) -> PixelRect:
        """A box of the view's pixels that holds all that `paint` would draw."""
        size = {"width_px": view.width_px, "height_px": view.height_px}
        boxes = []
        for item, matrix in zip(self._parts, stack_from_parts, strict=True):
            vertices = item.positions
            points = item.corners_m if len(vertices) > PROJECTED_MAX else vertices.astype(np.float64)
            placed = points @ matrix[:3, :3].T + matrix[:3, 3]
            if camera.depth_bounds(view.pixels_from_stack, placed) is not None:
                boxes.append(camera.covered_box(view.pixels_from_stack, placed, align_px=1, **size))
        return union(boxes)

    def deform(self, index: int, shape: Shape) -> None:
        """Another shape for a part: the same triangles, their vertices elsewhere."""
        item = self._parts[index]
        item.positions = shape.positions_m
        item.attributes[:, :3] = shape.normals
        item.surface_buffers[0].write(np.concatenate([shape.positions_m, item.attributes], axis=1, dtype=np.float32))
        if item.edges is not None:
            item.edges = item.edges.moved(shape)
        item.corners_m = camera.box_corners(shape.positions_m.min(0), shape.positions_m.max(0))

    def paint(self, view: View, stack_from_parts: Sequence[F64]) -> DrawnPicture:
        """The parts at their places (4x4 each, a similarity), over the background."""
        size = {"width_px": view.width_px, "height_px": view.height_px}
        corners = self.corners_m(stack_from_parts).reshape(-1, 8, 3)
        bounds = camera.depth_bounds(view.pixels_from_stack, corners.reshape(-1, 3))
        boxes = [camera.covered_box(view.pixels_from_stack, part, **size) for part in corners]
        area = union(boxes) if bounds else PixelRect(0, 0, 0, 0)
        # Nearest first: what they hide need not be shaded.
        order = np.argsort(-corners[..., 0].mean(1), kind="stable")
        placed = [(self._parts[index], stack_from_parts[index]) for index in order]

        def draw() -> None:
            near_m, far_m = bounds or (0.0, 0.0)
            clip = camera.clip_from_stack(view.pixels_from_stack, near_m=near_m, far_m=far_m, **size)
            self._context.enable_only(self._context.DEPTH_TEST)
            for item, stack_from_part in placed:
                self._describe(item.surface_program, item, stack_from_part, view)
                item.surface_program["clip_from_part"].write(_gl(clip @ stack_from_part))
                item.surface.render()
            if self._with_ramps:
                self._draw_outlines(placed, clip, view)

        return self._canvas.draw(side=view.side, box=area, paint=draw, **size)

    def close(self) -> None:
        """Release every GL object. May be called twice."""
        self._canvas.close()
        for item in self._parts:
            for held in (item.surface, *item.surface_buffers, item.outline, item.outline_buffer):
                held.release()
        for shared in (*self._textures.values(), *self._programs.values()):
            shared.release()
        self._parts, self._textures, self._programs = [], {}, {}

    def _upload(self, prepared: ReadyPart) -> _Uploaded:
        part, features, context = prepared.part, prepared.features, self._context
        surface_program, outline_program = self._program(features), self._program((*features, "OUTLINE"))
        triangles = context.buffer(np.ascontiguousarray(part.shape.triangles, np.int32))
        vertices = context.buffer(prepared.packed)
        names = ("in_normal", "in_uv", "in_colour")
        surface = context.vertex_array(
            surface_program,
            [_layout(surface_program, vertices, ("in_position", *names), (3, 3, 2, 3))],
            index_buffer=triangles,
        )
        edges = prepared.edges
        buffer = context.buffer(reserve=max(len(edges.faces) if edges else 0, 1) * OUTLINE_BYTES, dynamic=True)
        layout = _layout(outline_program, buffer, ("in_clip", "in_coverage", *names), (4, 1, 3, 2, 3))
        return _Uploaded(
            part=part,
            positions=part.shape.positions_m,
            surface=surface,
            surface_buffers=(vertices, triangles),
            outline=context.vertex_array(outline_program, [layout]),
            outline_buffer=buffer,
            edges=edges,
            texture=None if part.picture is None else self._texture(part.picture),
            surface_program=surface_program,
            outline_program=outline_program,
            corners_m=prepared.corners_m,
            attributes=prepared.attributes,
        )

    def _program(self, features: tuple[str, ...]) -> Any:
        if features not in self._programs:
            head = "#version 330\n" + "".join(f"#define {name}\n" for name in features)
            self._programs[features] = linked_program(self._context, vertex=head + VERTEX, fragment=head + FRAGMENT)
        return self._programs[features]

    def _texture(self, picture: U8) -> Any:
        if id(picture) not in self._textures:
            height, width = picture.shape[:2]
            texture = self._context.texture((width, height), 4, np.ascontiguousarray(picture).tobytes())
            texture.build_mipmaps()
            texture.filter = (self._context.LINEAR_MIPMAP_NEAREST, self._context.LINEAR)
            self._textures[id(picture)] = texture
        return self._textures[id(picture)]

    def _describe(self, program: Any, item: _Uploaded, stack_from_part: F64, view: View) -> None:
        linear = stack_from_part[:3, :3]
        if view.display_from_view is not None:
            linear = view.display_from_view @ linear
        if "stack_from_part" in program:
            program["stack_from_part"].write(_gl(np.linalg.pinv(linear).T * np.cbrt(abs(np.linalg.det(linear)))))
        program["colour"] = item.part.colour
        if item.texture is not None:
            item.texture.use(0)

    def _draw_outlines(self, placed: list[tuple[_Uploaded, F64]], clip_from_stack: F64, view: View) -> None:
        context, framebuffer = self._context, self._context.fbo
        context.enable_only(context.DEPTH_TEST | context.BLEND)
        context.blend_func = OVER
        framebuffer.depth_mask = False
        for item, stack_from_part in reversed(placed):
            if item.edges is None or not np.linalg.det(stack_from_part[:3, :3]):
                continue  # nor where it was squashed: then it has no inside
            eye = np.linalg.solve(stack_from_part, np.append(view.eye_m, 1.0))[:3]
            ends, apex = silhouette(item.edges, eye)
            clip_from_part = clip_from_stack @ stack_from_part
            clip = item.positions @ clip_from_part[:, :3].T + clip_from_part[:, 3]
            corners, vertices, _ = ramps(clip, ends, apex, width_px=view.width_px, height_px=view.height_px)
            if not len(corners):
                continue
            packed = np.concatenate([corners.reshape(-1, 5), item.attributes[vertices.reshape(-1)]], axis=1)
            item.outline_buffer.write(packed)
            self._describe(item.outline_program, item, stack_from_part, view)
            item.outline.render(vertices=len(packed))
        framebuffer.depth_mask = True


def _attributes(part: Part) -> F32:
    """(v, 8): normal, texture coordinates, colour."""
    mesh = part.shape
    colours = np.ones_like(mesh.positions_m) if part.vertex_colours is None else part.vertex_colours
    return np.concatenate([mesh.normals, mesh.uv, colours], axis=1, dtype=np.float32)


def _gl(matrix: F64) -> F32:
    """Column by column, as GL reads a matrix."""
    return np.ascontiguousarray(matrix.T, np.float32)


def _layout(program: Any, buffer: Any, names: tuple[str, ...], sizes: tuple[int, ...]) -> tuple[Any, ...]:
    """A buffer's description for a program; what the compiler left out is skipped."""
    used = [name for name in names if name in program]
    formats = [f"{size}f" if name in used else f"{size * 4}x" for name, size in zip(names, sizes, strict=True)]
    return (buffer, " ".join(formats), *used)
