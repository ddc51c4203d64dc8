"""Draw textured, coloured and lit triangles by OpenGL shaders with only the features needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.content import camera
from runtime.content.base import ContentInfo, View
from runtime.content.canvas import OVER, CanvasSource
from runtime.content.fringe import CORNER_FLOATS, TRIANGLES, OutlineRamps, edges_of
from runtime.content.parts import OPAQUE_FROM, OUTLINED_MAX, Part, Sampler
from runtime.content.shapes import solid_winding
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64, U8
from runtime.support.gl import DrawnPicture, set_uniforms

PROJECTED_MAX = 5000  # if a part has more vertices, its box is projected instead to find its extent
ATTRIBUTES = ("in_normal", "in_uv", "in_colour")

ANY_ALPHA = 2.0  # limit that is larger than any alpha
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
in vec4 in_colour;
uniform mat3 stack_from_part;
uniform vec4 colour;
out vec2 uv;
out vec4 shade;
out float coverage;
const vec3 TO_LAMP = vec3(0.66, -0.36, 0.66);
void main() {
    shade = colour;
#ifdef COLOURED
    shade *= in_colour;
#endif
#ifdef LIT
    vec3 normal = stack_from_part * in_normal;
    float lamp = 0.38 + 0.62 * (0.5 + 0.5 * dot(normal, TO_LAMP) / max(length(normal), 1e-6));
#ifdef LINEAR
    lamp = pow(lamp, 2.2);
#endif
    shade.rgb *= lamp;
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
in vec4 shade;
in float coverage;
out vec4 pixel;
uniform sampler2D picture;
uniform sampler2D glow_picture;
uniform vec3 glow;
uniform vec2 kept;  // drawn from kept.x to below kept.y
float mirrored(float place) { return abs(mod(place + 1.0, 2.0) - 1.0); }
vec3 linear(vec3 code) { return mix(code / 12.92, pow((code + 0.055) / 1.055, vec3(2.4)), step(0.04045, code)); }
vec3 coded(vec3 light) {
    return mix(light * 12.92, 1.055 * pow(max(light, 0.0), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, light));
}
void main() {
    vec3 rgb = shade.rgb;
    float alpha = shade.a;
    vec2 place = uv;
#ifdef MIRROR_U
    place.x = mirrored(place.x);
#endif
#ifdef MIRROR_V
    place.y = mirrored(place.y);
#endif
#ifdef PICTURE
    vec4 texel = texture(picture, place);
    alpha *= texel.a;
#ifdef LINEAR
    texel.rgb = linear(texel.rgb);
#endif
    rgb *= texel.rgb;
#endif
#if defined(HOLES) || defined(BLEND)
    if (alpha < kept.x || alpha >= kept.y) discard;
#endif
#ifdef GLOW
    vec3 own = glow;
#ifdef GLOW_PICTURE
    own *= linear(texture(glow_picture, place).rgb);
#endif
    rgb += own;
#endif
#ifdef LINEAR
    rgb = coded(rgb);
#endif
#ifdef GREY
    rgb = vec3(dot(rgb, vec3(0.299, 0.587, 0.114)));
#endif
#ifdef BLEND
    pixel = vec4(rgb, kept.y > 1.0 ? 1.0 : alpha);
#else
    pixel = vec4(rgb, coverage);
#endif
}
"""


class DrawnPart:
    """Part prepared without a GL context, on any thread. After `upload`, it also owns GL objects."""

    def __init__(self, part: Part, *, outlined: bool = True) -> None:
        """Prepare a part, with edges for smooth outlines if `outlined` and neither translucent nor large."""
        mesh = part.shape
        self.features, self.sampler = part.features, part.sampler
        self.pictures, self.glow, self.two_sided = (part.picture, part.glow_picture), part.glow, part.two_sided
        self.colour, self.cutoff = (*part.colour, part.opacity), part.cutoff
        self.is_blended = "BLEND" in self.features
        self.triangles = np.ascontiguousarray(mesh.triangles, np.int32)
        self.corner_count, self.is_projected = self.triangles.size, len(mesh.positions_m) <= PROJECTED_MAX
        # (v, 12) position (3), normal (3), texture coordinates (2), colour and alpha (4)
        self.vertices = np.ones((len(mesh.positions_m), 12), np.float32)
        for first, values in ((0, mesh.positions_m), (3, mesh.normals), (6, mesh.uv), (8, part.vertex_colours)):
            if values is not None:
                self.vertices[:, first : first + values.shape[1]] = values
        outlined = outlined and not self.is_blended and len(mesh.triangles) <= OUTLINED_MAX
        self.edges = edges_of(mesh) if outlined else None
        # A part with a border is not solid, and the full check takes as long as finding the edges.
        may_be_solid = self.edges is not None and not self.edges.border.any() and "HOLES" not in self.features
        self._solid_winding = solid_winding(mesh) if may_be_solid else 0
        low, high = mesh.positions_m.min(0), mesh.positions_m.max(0)
        if part.turning:
            reach = float(np.linalg.norm(mesh.positions_m, axis=1).max())
            low, high = np.full(3, -reach), np.full(3, reach)
        self._low_m, self._high_m = low, high
        self.corners_m = camera.box_corners(low, high)  # (8, 3) corners of the bounding box, in the part's frame
        self.textures: list[Any] = []

    @property
    def positions(self) -> F32:
        """Vertex positions (v, 3) in the part's frame. They may be empty after `upload`."""
        return self.vertices[:, :3]

    def front_faces(self, look: _Look) -> str | None:
        """Return the winding of the visible faces in a picture (`cw` or `ccw`), or None if both may be."""
        if not self._solid_winding or look.eye is None:
            return None
        if not ((look.eye < self._low_m) | (look.eye > self._high_m)).any():  # from within, the inside is visible
            return None
        return look.front_face if self._solid_winding > 0 else {"cw": "ccw", "ccw": "cw"}[look.front_face]

    def upload(self, context: Any, surface_program: Any, outline: Any, textures: list[Any]) -> None:
        """Create the part's GL objects; the source owns program, outlines' vertex array and textures."""
        self.surface_program, self.outline, self.textures = surface_program, outline, textures
        self._buffer, self._triangles = (context.buffer(array) for array in (self.vertices, self.triangles))
        if self.edges is None and not self.is_projected:  # this may free hundreds of MiB
            self.vertices, self.triangles = self.vertices[:0].copy(), self.triangles[:0].copy()
        layout = (self._buffer, "3f 3f 2f 4f", "in_position", *ATTRIBUTES)  # the compiler may have removed some
        self.surface = context.vertex_array(surface_program, [layout], index_buffer=self._triangles, skip_errors=True)

    def draw_surface(self) -> None:
        """Draw the triangles."""
        self.surface.render(vertices=self.corner_count)

    def release(self) -> None:
        """Release the GL objects that the part owns. Releasing a vertex array does not release its buffers."""
        for held in (self.surface, self._buffer, self._triangles):
            held.release()


class _Place:
    """A part's placement in a scene, with the matrices that do not depend on the view."""

    def __init__(self, stack_from_part: F64) -> None:
        linear = stack_from_part[:3, :3]
        volume = float(np.linalg.det(linear))
        self.stack_from_part = stack_from_part
        self.part_from_stack = np.linalg.inv(stack_from_part) if volume else None  # None if the part is flattened
        self.is_mirrored = volume < 0
        self.normals = np.linalg.pinv(linear).T * np.cbrt(abs(volume))


class _Look:
    """A part's placement as seen in one view, with the matrices that its shaders need."""

    def __init__(self, place: _Place, clip_from_stack: F64, view: View) -> None:
        inverse = place.part_from_stack
        # The raster's rows run along +y in OpenGL, which mirrors triangles.
        self.front_face = "ccw" if place.is_mirrored else "cw"
        self.eye = None if inverse is None else inverse[:3, :3] @ view.eye_m + inverse[:3, 3]  # None if flattened
        turned = place.normals if view.display_from_view is None else view.display_from_view @ place.normals
        self.clip_from_part = clip_from_stack @ place.stack_from_part
        self._clip, self._normals = _gl(self.clip_from_part), _gl(turned)

    def set(self, program: Any, part: DrawnPart) -> None:
        """Set the uniforms and textures that a program needs to draw a part."""
        for name, matrix in (("stack_from_part", self._normals), ("clip_from_part", self._clip)):
            if (uniform := program.get(name, None)) is not None:
                uniform.write(matrix)
        set_uniforms(program, {"colour": part.colour, "glow": part.glow, "glow_picture": len(part.textures) - 1})
        for unit, texture in enumerate(part.textures):
            texture.use(unit)


@dataclass(frozen=True, slots=True)
class _Arrangement:
    """The placements of all of a scene's parts at one time."""

    places: list[_Place]  # placement of each part; parts may share a placement
    points_m: F64  # (n, 3) points in frame `stack`; their convex hull contains all parts
    corners_m: F64  # (p, 8, 3) corners of each part's bounding box, frame `stack`
    nearest_first: NDArray[np.intp]  # (p,) indices of the parts, nearest first


class TriangleSource(CanvasSource):
    """Source that draws parts, each with a placement, over a uniform background."""

    def __init__(
        self,
        parts: Sequence[DrawnPart],
        stack_from_parts: Sequence[F64],
        *,
        context: Any,
        info: ContentInfo,
        samples: int = 0,
    ) -> None:
        """Create the source of parts, each placed by a 4x4 similarity. With 0 samples per pixel, outlines are smoothed
        with ramps, which is faster on a software rasteriser.
        """
        super().__init__(context, info=info, samples=samples)
        self.parts, self.stack_from_parts = list(parts), list(stack_from_parts)
        self._with_ramps = samples == 0
        self._still: _Arrangement | None = None  # arrangement, if the scene is static
        self._programs: dict[tuple[str, ...], Any] = {}
        self._textures: dict[tuple[int, Sampler], Any] = {}
        outlined = {n: (part.edges, part.vertices) for n, part in enumerate(self.parts) if part.edges is not None}
        self._ramps = OutlineRamps(outlined) if outlined and self._with_ramps else None
        first_corners = 4 * np.arange(max(sum(len(edges.faces) for edges, _ in outlined.values()), 1), dtype=np.int32)
        self._outline_buffer = context.buffer(reserve=4 * 4 * CORNER_FLOATS * first_corners.size, dynamic=True)
        self._outline_triangles = context.buffer(first_corners[:, None] + np.array(TRIANGLES, np.int32))
        self._outlines: dict[tuple[str, ...], Any] = {}
        for part in self.parts:
            pictures = [picture for picture in part.pictures if picture is not None]
            textures = [self._texture(picture, part.sampler) for picture in pictures]
            part.upload(context, self._program(part.features), self._outline(part.features), textures)
        self.held += [*self.parts, *self._outlines.values(), self._outline_buffer, self._outline_triangles]
        self.held += [*self._textures.values(), *self._programs.values()]

    def places(self, time_ns: int) -> Sequence[F64]:
        """Return each part's 4x4 placement at a given time; subclasses for moving scenes override this."""
        return self.stack_from_parts

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        return camera.covered_box(view, self._arranged(time_ns).points_m, align_px=1)

    def _arranged(self, time_ns: int) -> _Arrangement:
        matrices = self.places(time_ns)
        is_still = matrices is self.stack_from_parts
        if is_still and self._still is not None:
            return self._still
        shared = {id(matrix): _Place(matrix) for matrix in matrices}
        points, corners = [], []
        for part, matrix in zip(self.parts, matrices, strict=True):
            corners.append(part.corners_m @ matrix[:3, :3].T + matrix[:3, 3])
            is_few = part.is_projected
            points.append(part.positions @ matrix[:3, :3].T + matrix[:3, 3] if is_few else corners[-1])
        # Drawing the nearest parts first avoids shading hidden pixels.
        order = np.argsort([-box[:, 0].mean() for box in corners], kind="stable")
        found = _Arrangement([shared[id(m)] for m in matrices], np.concatenate(points), np.stack(corners), order)
        if is_still:
            self._still = found
        return found

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        """Draw a view's picture. Drawing the same view at the same time gives identical pixels."""
        arranged = self._arranged(time_ns)
        corners_m = arranged.corners_m.reshape(-1, 3)
        area = camera.covered_box(view, corners_m)

        def paint() -> None:
            near_m, far_m = self._bounds[view.side] = camera.depth_bounds(view, corners_m)
            clip = camera.clip_from_stack(view, near_m=near_m, far_m=far_m)
            shared = {id(place): _Look(place, clip, view) for place in arranged.places}
            looks = [shared[id(place)] for place in arranged.places]
            placed = [(self.parts[n], looks[n]) for n in arranged.nearest_first]
            self.context.enable_only(self.context.DEPTH_TEST)
            self.context.cull_face = "back"
            for part, look in placed:
                if (front := part.front_faces(look)) is None:
                    self.context.disable(self.context.CULL_FACE)
                else:
                    self.context.enable(self.context.CULL_FACE)
                    self.context.front_face = front
                look.set(part.surface_program, part)
                least = OPAQUE_FROM if part.is_blended else part.cutoff
                set_uniforms(part.surface_program, {"kept": (least, ANY_ALPHA)})
                part.draw_surface()
            if self._ramps is not None:
                self._draw_outlines(self._ramps, looks, arranged.nearest_first, view)
            if any(part.is_blended for part in self.parts):
                self._draw_translucent(placed)

        return self.drawn(view, area, paint)

    def _draw_translucent(self, placed: list[tuple[DrawnPart, _Look]]) -> None:
        """Blend translucent parts over opaque parts, farthest first, and each part's back faces before its front."""
        context, framebuffer = self.context, self.context.fbo
        context.enable_only(context.DEPTH_TEST | context.BLEND | context.CULL_FACE)
        context.blend_func = OVER
        framebuffer.depth_mask = False
        for part, look in reversed(placed):
            if part.is_blended:
                look.set(part.surface_program, part)
                context.front_face = look.front_face
                set_uniforms(part.surface_program, {"kept": (1 / 255, OPAQUE_FROM)})
                for hidden in ("front", "back") if part.two_sided else ("back",):
                    context.cull_face = hidden
                    part.draw_surface()
        framebuffer.depth_mask = True
        context.disable(context.CULL_FACE)

    def _program(self, features: tuple[str, ...]) -> Any:
        if features not in self._programs:
            head = "#version 330\n" + "".join(f"#define {name}\n" for name in features)
            shaders = {"vertex_shader": head + VERTEX, "fragment_shader": head + FRAGMENT}
            self._programs[features] = self.context.program(**shaders)
        return self._programs[features]

    def _outline(self, features: tuple[str, ...]) -> Any:
        """Return the vertex array for drawing the outlines of parts with the given features."""
        if features not in self._outlines:
            program = self._program((*features, "OUTLINE"))
            layout = (self._outline_buffer, "4f 1f 3f 2f 4f", "in_clip", "in_coverage", *ATTRIBUTES)
            self._outlines[features] = self.context.vertex_array(
                program, [layout], index_buffer=self._outline_triangles, skip_errors=True
            )
        return self._outlines[features]

    def _texture(self, picture: U8, sampler: Sampler) -> Any:
        key = (id(picture), sampler)
        if key not in self._textures:
            height, width = picture.shape[:2]
            texture = self.context.texture((width, height), 4, np.ascontiguousarray(picture).tobytes())
            texture.build_mipmaps()
            enlarged = self.context.NEAREST if sampler.nearest else self.context.LINEAR
            texture.filter = (self.context.LINEAR_MIPMAP_LINEAR, enlarged)
            texture.repeat_x, texture.repeat_y = (wrap == "repeat" for wrap in sampler.wrap)
            self._textures[key] = texture
        return self._textures[key]

    def _draw_outlines(
        self, ramps: OutlineRamps, looks: list[_Look], nearest_first: NDArray[np.intp], view: View
    ) -> None:
        """Draw ramps along all parts' outlines, farthest part first."""
        seen = [
            (n, eye, looks[n].clip_from_part)
            for n in nearest_first[::-1].tolist()
            if self.parts[n].edges is not None and (eye := looks[n].eye) is not None
        ]
        size = {"width_px": view.width_px, "height_px": view.height_px}
        corners, counts = ramps.along(seen, **size, ramp_px=1 / view.reduction)
        self._outline_buffer.write(corners)
        context, framebuffer = self.context, self.context.fbo
        context.enable_only(context.DEPTH_TEST | context.BLEND)
        context.blend_func = OVER
        framebuffer.depth_mask = False
        begin = 0
        for (n, _, _), count in zip(seen, counts, strict=True):
            if count:
                part = self.parts[n]
                looks[n].set(part.outline.program, part)
                set_uniforms(part.outline.program, {"kept": (part.cutoff, ANY_ALPHA)})
                part.outline.render(first=len(TRIANGLES) * begin, vertices=len(TRIANGLES) * count)
                begin += count
        framebuffer.depth_mask = True


def _gl(matrix: F64) -> F32:
    """Return a matrix in the column-major order that OpenGL expects."""
    return np.ascontiguousarray(matrix.T, np.float32)
