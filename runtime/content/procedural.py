"""The built-in scenes, drawn straight into the pixels that a view asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.content import camera, shapes, textures
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.canvas import Canvas
from runtime.content.scenes import Part, Scene, scene
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

MODELLED_HEIGHT_M = 0.2916  # the display for which the scenes' lengths are written

VERTEX = """
#version 330
uniform mat4 clip_from_part;
uniform mat3 stack_from_part;
uniform vec3 colour;
uniform float lit;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
out vec2 uv;
out vec3 shade;
const vec3 TO_LAMP = vec3(0.66, -0.36, 0.66);
void main() {
    float lamp = 0.5 + 0.5 * dot(stack_from_part * in_normal, TO_LAMP);
    shade = colour * mix(1.0, 0.38 + 0.62 * lamp, lit);
    uv = in_uv;
    gl_Position = clip_from_part * vec4(in_position, 1.0);
}
"""
FRAGMENT = """
#version 330
uniform sampler2DArray pictures;
uniform float layer;
uniform float grey;
in vec2 uv;
in vec3 shade;
out vec4 pixel;
void main() {
    vec3 rgb = texture(pictures, vec3(uv, layer)).rgb * shade;
    pixel = vec4(mix(rgb, vec3(dot(rgb, vec3(0.299, 0.587, 0.114))), grey), 1.0);
}
"""


@dataclass(frozen=True, slots=True)
class _Drawn:
    part: Part
    vertices: Any
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
        described = scene(built_in) if isinstance(built_in, str) else built_in
        self._scene = described
        self._context = context
        self._scale = stack.height_m / MODELLED_HEIGHT_M
        self._canvas = Canvas(context, samples=samples, background=background)
        self._program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
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
                self._paint_part(drawn, clip, stack_from_part)

        return self._canvas.draw(side=view.side, box=area, paint=paint, **size)

    def close(self) -> None:
        self._canvas.close()
        for drawn in self._drawn:
            drawn.vertices.release()
        self._drawn = []
        self._texture.release()
        self._program.release()

    def _uploaded(self, part: Part) -> _Drawn:
        mesh = part.shape
        packed = np.concatenate([mesh.positions_m, mesh.normals, mesh.uv], axis=1).astype(np.float32)
        vertices = self._context.vertex_array(
            self._program,
            [(self._context.buffer(packed.tobytes()), "3f 3f 2f", "in_position", "in_normal", "in_uv")],
            index_buffer=self._context.buffer(mesh.triangles.astype(np.int32).tobytes()),
        )
        low, high = mesh.positions_m.min(0), mesh.positions_m.max(0)
        if part.turns_per_s and self._scene.moving:
            reach = float(np.linalg.norm(mesh.positions_m, axis=1).max())
            low, high = np.full(3, -reach), np.full(3, reach)
        return _Drawn(part, vertices, camera.box_corners(low, high))

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

    def _paint_part(self, drawn: _Drawn, clip_from_stack: F64, stack_from_part: F64) -> None:
        program, part = self._program, drawn.part
        program["clip_from_part"].write(np.ascontiguousarray((clip_from_stack @ stack_from_part).T, np.float32))
        program["stack_from_part"].write(np.ascontiguousarray(stack_from_part[:3, :3].T / self._scale, np.float32))
        program["colour"] = part.colour
        program["lit"] = float(part.lit)
        program["layer"] = float(self._layers[part.texture])
        program["grey"] = float(self._scene.grey)
        drawn.vertices.render()
