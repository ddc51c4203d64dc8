"""The built-in scenes, drawn straight into the pixels that a view asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np

from runtime.clock import NS_PER_S
from runtime.content import camera, shapes, textures
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.canvas import Canvas
from runtime.content.fringe import Edges, edges_of, ramps, silhouette
from runtime.content.scenes import Part, Scene, scene
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

OUTLINE_BYTES = 6 * 10 * 4  # an edge's two triangles of ten floats a corner
OVER = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)
MODELLED_HEIGHT_M = 0.2916  # the display for which the scenes' lengths are written

SHADING = """#version 330
uniform mat3 stack_from_part;
uniform vec3 colour;
uniform float lit;
const vec3 TO_LAMP = vec3(0.66, -0.36, 0.66);
vec3 shade_of(vec3 normal) {
    float lamp = 0.5 + 0.5 * dot(stack_from_part * normal, TO_LAMP);
    return colour * mix(1.0, 0.38 + 0.62 * lamp, lit);
}
"""
SURFACE_VERTEX = (
    SHADING
    + """
uniform mat4 clip_from_part;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
out vec2 uv;
out vec3 shade;
out float coverage;
void main() {
    uv = in_uv;
    shade = shade_of(in_normal);
    coverage = 1.0;
    gl_Position = clip_from_part * vec4(in_position, 1.0);
}
"""
)
OUTLINE_VERTEX = (
    SHADING
    + """
in vec4 in_clip;
in float in_coverage;
in vec3 in_normal;
in vec2 in_uv;
out vec2 uv;
out vec3 shade;
out float coverage;
void main() {
    uv = in_uv;
    shade = shade_of(in_normal);
    coverage = in_coverage;
    gl_Position = in_clip;
}
"""
)
FRAGMENT = """#version 330
uniform sampler2DArray pictures;
uniform float layer;
uniform float grey;
in vec2 uv;
in vec3 shade;
in float coverage;
out vec4 pixel;
void main() {
    vec3 rgb = texture(pictures, vec3(uv, layer)).rgb * shade;
    pixel = vec4(mix(rgb, vec3(dot(rgb, vec3(0.299, 0.587, 0.114))), grey), coverage);
}
"""


@dataclass(frozen=True, slots=True)
class _Drawn:
    part: Part
    surface: Any
    outline: Any
    outline_buffer: Any
    edges: Edges
    corners_m: F64  # (8, 3) of the box that holds it however it turns; frame of the part


class ProceduralSource(ContentSource):
    """A built-in scene, scaled to the display's height."""

    def __init__(
        self,
        built_in: str | Scene,
        *,
        stack: PanelStack,
        context: Any,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        samples: int = 0,
    ) -> None:
        """samples: per pixel, for outlines; 0: ramps along the outlines, which a software rasteriser draws faster."""
        described = scene(built_in) if isinstance(built_in, str) else built_in
        self._scene = described
        self._context = context
        self._scale = stack.height_m / MODELLED_HEIGHT_M
        self._canvas = Canvas(context, samples=samples, background=background)
        self._with_ramps = samples == 0
        self._surface = context.program(vertex_shader=SURFACE_VERTEX, fragment_shader=FRAGMENT)
        self._outline = context.program(vertex_shader=OUTLINE_VERTEX, fragment_shader=FRAGMENT)
        pictures, self._layers = textures.texture_array()
        self._texture = context.texture_array(
            (textures.SIZE_PX, textures.SIZE_PX, len(pictures)), 4, pictures.tobytes()
        )
        self._texture.build_mipmaps()
        self._texture.filter = (context.LINEAR_MIPMAP_NEAREST, context.LINEAR)
        self._drawn = [self._uploaded(part) for part in described.parts]
        corners = np.concatenate([self._placed(drawn, 0.0)[1] for drawn in self._drawn])
        self.info = ContentInfo(
            name=described.name,
            moving=described.moving,
            grey=described.grey,
            depth_range_m=(float(corners[:, 0].min()), float(corners[:, 0].max())),
            background=background,
            flat_x_m=0.0 if described.flat else None,
        )

    def render(self, view: View, *, time_ns: int) -> U8:
        """The scene through the view's projection; the same bytes for the same view and time."""
        placed = [(drawn, *self._placed(drawn, time_ns / NS_PER_S)) for drawn in self._drawn]
        size = {"width_px": view.width_px, "height_px": view.height_px}
        placed.sort(key=lambda entry: -float(entry[2][:, 0].mean()))  # nearest first: what they hide isn't shaded
        corners = np.concatenate([corners_m for _, _, corners_m in placed])
        bounds = camera.depth_bounds(view.pixels_from_stack, corners)
        boxes = [camera.covered_box(view.pixels_from_stack, corners_m, **size) for _, _, corners_m in placed]
        area = camera.union(boxes) if bounds else camera.PixelBox(0, 0, 0, 0)

        def paint() -> None:
            near_m, far_m = bounds or (0.0, 0.0)
            clip = camera.clip_from_stack(view.pixels_from_stack, near_m=near_m, far_m=far_m, **size)
            self._context.enable_only(self._context.DEPTH_TEST)
            self._texture.use(0)
            for drawn, stack_from_part, _ in placed:
                self._paint_surface(drawn, clip, stack_from_part)
            if self._with_ramps:
                self._paint_outlines(placed, clip, view)

        return self._canvas.draw(side=view.side, box=area, paint=paint, **size)

    def close(self) -> None:
        self._canvas.close()
        for drawn in self._drawn:
            for held in (drawn.surface, drawn.outline, drawn.outline_buffer):
                held.release()
        self._drawn = []
        for shared in (self._texture, self._surface, self._outline):
            shared.release()

    def _uploaded(self, part: Part) -> _Drawn:
        mesh = part.shape
        packed = np.concatenate([mesh.positions_m, mesh.normals, mesh.uv], axis=1).astype(np.float32)
        surface = self._context.vertex_array(
            self._surface,
            [(self._context.buffer(packed.tobytes()), "3f 3f 2f", "in_position", "in_normal", "in_uv")],
            index_buffer=self._context.buffer(mesh.triangles.astype(np.int32).tobytes()),
        )
        edges = edges_of(mesh)
        buffer = self._context.buffer(reserve=max(len(edges.faces), 1) * OUTLINE_BYTES, dynamic=True)
        layout = [(buffer, "4f 1f 3f 2f", "in_clip", "in_coverage", "in_normal", "in_uv")]
        outline = self._context.vertex_array(self._outline, layout)
        low, high = mesh.positions_m.min(0), mesh.positions_m.max(0)
        if part.turns_per_s and self._scene.moving:
            reach = float(np.linalg.norm(mesh.positions_m, axis=1).max())
            low, high = np.full(3, -reach), np.full(3, reach)
        return _Drawn(part, surface, outline, buffer, edges, camera.box_corners(low, high))

    def _placed(self, drawn: _Drawn, time_s: float) -> tuple[F64, F64]:
        """4x4 stack_from_part at a time, and the (8, 3) corners of its box in the stack frame."""
        part = drawn.part
        turn = np.eye(3) if part.rotation is None else part.rotation
        if self._scene.moving and part.turns_per_s:
            turn = shapes.rotation_about(2, 2 * np.pi * part.turns_per_s * time_s) @ turn
        matrix = np.eye(4)
        matrix[:3, :3] = turn * self._scale
        matrix[:3, 3] = np.asarray(part.centre_m) * self._scale
        return matrix, drawn.corners_m @ matrix[:3, :3].T + matrix[:3, 3]

    def _describe(self, program: Any, drawn: _Drawn, stack_from_part: F64) -> None:
        part = drawn.part
        program["stack_from_part"].write(np.ascontiguousarray(stack_from_part[:3, :3].T / self._scale, np.float32))
        program["colour"] = part.colour
        program["lit"] = float(part.lit)
        program["layer"] = float(self._layers[part.texture])
        program["grey"] = float(self._scene.grey)

    def _paint_surface(self, drawn: _Drawn, clip_from_stack: F64, stack_from_part: F64) -> None:
        self._describe(self._surface, drawn, stack_from_part)
        clip_from_part = np.ascontiguousarray((clip_from_stack @ stack_from_part).T, np.float32)
        self._surface["clip_from_part"].write(clip_from_part)
        drawn.surface.render()

    def _paint_outlines(self, placed: list[tuple[_Drawn, F64, F64]], clip_from_stack: F64, view: View) -> None:
        context, framebuffer = self._context, self._context.fbo
        context.enable_only(context.DEPTH_TEST | context.BLEND)
        context.blend_func = OVER
        framebuffer.depth_mask = False
        for drawn, stack_from_part, _ in reversed(placed):
            mesh = drawn.part.shape
            eye = np.linalg.solve(stack_from_part, np.append(view.eye_m, 1.0))[:3]
            ends, apex = silhouette(drawn.edges, eye)
            clip_from_part = clip_from_stack @ stack_from_part
            clip = mesh.positions_m @ clip_from_part[:, :3].T + clip_from_part[:, 3]
            corners, vertices, _ = ramps(clip, ends, apex, width_px=view.width_px, height_px=view.height_px)
            if not len(corners):
                continue
            packed = np.concatenate([corners, mesh.normals[vertices], mesh.uv[vertices]], axis=2)
            drawn.outline_buffer.write(np.ascontiguousarray(packed, np.float32))
            self._describe(self._outline, drawn, stack_from_part)
            drawn.outline.render(vertices=packed.shape[0] * packed.shape[1])
        framebuffer.depth_mask = True
