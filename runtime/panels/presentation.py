"""Draw the panels' records (optics/presentation.py) using OpenGL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import moderngl
import numpy as np

from runtime.config import PanelSettings
from runtime.optics.presentation import Mount, PanelDraw, flatness_of
from runtime.panels import lut
from runtime.panels.geometry import layer_from_screen, permutes_pixels
from runtime.records import F32, U8, PanelFrame
from runtime.support.gl import set_uniforms

VERTEX = """#version 330 core
// One triangle that covers the framebuffer; pixel: the monitor's pixels, top left origin, v down.
uniform vec2 screen_px;
uniform mat3 layer_from_screen;
out vec3 layer_px;
void main() {
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(corner * 2.0 - 1.0, 0.0, 1.0);
    vec2 pixel = vec2(corner.x, 1.0 - corner.y) * screen_px;
    layer_px = layer_from_screen * vec3(pixel, 1.0);
}
"""

# The law is that of runtime.optics.presentation, whose records the uniforms hold. Weights have full precision, because
# hardware filters round them to steps of 1/256. Each case has its own program, because a software rasteriser executes
# both branches of every `if`: a single program for all cases would take several times as long as the slowest of these.
FRAGMENT = """
uniform sampler2D solved;        // this panel's layer of the solution
uniform sampler2D flat_picture;
uniform sampler2D curve;
uniform sampler2D relief;
uniform vec2 size_px;            // the panel's columns and rows
uniform vec2 solved_px;          // the solution's
uniform vec2 relief_px;
uniform int extended_px;
uniform vec4 solved_from_shown;  // scale u, v, shift u, v, as in the other maps
uniform vec4 relief_from_shown;
uniform vec4 push;
uniform float flatness;
uniform float rest;
in vec3 layer_px;
out vec4 colour;
#ifdef CURVED
float grey(float phase, int channel) {
    return texture(curve, vec2((phase * 255.0 + 0.5) / 256.0, (float(channel) + 0.5) / 3.0)).r;
}
#else
float grey(float phase, int channel) { return phase; }
#endif
vec2 mapped(vec4 by, vec2 px) { return px * by.xy + by.zw; }
vec3 texel(ivec2 at) {
    ivec2 size = ivec2(solved_px);
    bool inside = all(greaterThanEqual(at, ivec2(-extended_px))) && all(lessThan(at, size + extended_px));
    return inside ? texelFetch(solved, clamp(at, ivec2(0), size - 1), 0).rgb : vec3(rest);
}
vec4 cubic(float t) {  // weights of four neighbours
    vec4 d = vec4(1.0 + t, t, 1.0 - t, 2.0 - t);
    vec4 near = (1.25 * d - 2.25) * d * d + 1.0;
    vec4 far = ((-0.75 * d + 3.75) * d - 6.0) * d + 3.0;
    return vec4(far.x, near.y, near.z, far.w);
}
vec3 solved_codes(vec2 px) {
#ifdef COPY
    return texelFetch(solved, ivec2(floor(px)), 0).rgb;
#else
    vec2 place = mapped(solved_from_shown, px) - 0.5;
#ifdef DISPLACED
    place += texture(relief, mapped(relief_from_shown, px) / relief_px).r * mapped(push, px);
#endif
    place = clamp(place, vec2(-3.0), solved_px + 2.0);
    vec2 low = floor(place), weight = place - low;
    ivec2 at = ivec2(low);
#ifdef CUBIC
    vec4 across = cubic(weight.x), down = cubic(weight.y);
    vec3 total = vec3(0.0);
    for (int j = 0; j < 4; j++)
        for (int i = 0; i < 4; i++) total += across[i] * down[j] * texel(at + ivec2(i - 1, j - 1));
    return clamp(total, 0.0, 1.0);
#else
    return mix(mix(texel(at), texel(at + ivec2(1, 0)), weight.x),
               mix(texel(at + ivec2(0, 1)), texel(at + ivec2(1, 1)), weight.x), weight.y);
#endif
#endif
}
vec3 flat_codes(vec2 px) {
#ifdef EXACT
    return texelFetch(flat_picture, ivec2(floor(px)), 0).rgb;
#else
    return texture(flat_picture, px / size_px).rgb;
#endif
}
vec3 shown(vec2 px) {
#if !defined(SOLVED)
    return flat_codes(px);
#elif defined(MIXED)
    return mix(solved_codes(px), flat_codes(px), flatness);
#else
    return solved_codes(px);
#endif
}
void main() {
    vec2 px = layer_px.xy / layer_px.z;
    vec3 phase = vec3(0.0);
    if (layer_px.z > 0.0 && all(greaterThanEqual(px, vec2(0.0))) && all(lessThan(px, size_px))) phase = shown(px);
    colour = vec4(grey(phase.r, 0), grey(phase.g, 1), grey(phase.b, 2), 1.0);
}
"""


Case = tuple[str, ...]  # macros to define in the fragment shader


def case_of(draw: PanelDraw) -> Case:
    """Return the macros for a record."""
    solved = (draw.interpolation.name, *["DISPLACED"] * (draw.relief is not None), *["MIXED"] * draw.shows_flat)
    return ("SOLVED", *solved) if draw.shows_solved else ()


def cases_of(mount: Mount) -> tuple[Case, ...]:
    """Return all cases that occur on a monitor."""
    ways = (("COPY",), ("LINEAR",), ("LINEAR", "DISPLACED")) if mount.is_exact else (("CUBIC",), ("CUBIC", "DISPLACED"))
    return ((), *(("SOLVED", *way, *mixed) for way in ways for mixed in ((), ("MIXED",))))


class FrameTextures:
    """Uploads the latest frame's layers to textures whenever their version changes."""

    def __init__(self, context: moderngl.Context, *, count: int) -> None:
        """Create an empty set of textures for `count` panels."""
        self._context = context
        self.count = count
        self._textures: dict[tuple[str, tuple[int, int]], tuple[moderngl.Texture, ...]] = {}  # keyed by kind and size
        self._solved: tuple[moderngl.Texture, ...] = ()
        self._flat: tuple[moderngl.Texture, ...] = ()
        self._reliefs: dict[tuple[int, int], moderngl.Texture] = {}  # keyed by size
        self._relief: moderngl.Texture | None = None  # the uploaded solution's relief
        self._solved_version: int | None = None
        self._flat_version: int | None = None

    def lacks(self, frame: PanelFrame) -> tuple[bool, bool]:
        """Return whether the solution and the flat picture are visible but not uploaded."""
        flatness = flatness_of(frame)
        return (
            flatness < 1.0 and frame.solved_version != self._solved_version,
            flatness > 0.0 and frame.flat_version != self._flat_version,
        )

    def upload(self, frame: PanelFrame) -> None:
        """Upload all pictures that are visible in a frame and have not been uploaded yet."""
        lacks_solved, lacks_flat = self.lacks(frame)
        if lacks_solved and frame.solved is not None:
            self._solved_version = None  # stays None if the upload fails
            self._solved = self._written("solved", frame.solved)
            self._relief = None if frame.relief is None else self._relief_of(frame.relief)
            self._solved_version = frame.solved_version
        if lacks_flat and frame.flat is not None:
            self._flat_version = None
            self._flat = self._written("flat", frame.flat)
            self._flat_version = frame.flat_version

    def use(self, index: int) -> None:
        """Bind one panel's textures to the texture units read by `Painter`, in the current context."""
        for unit, uploaded in enumerate((self._solved, self._flat)):
            if uploaded:
                uploaded[index].use(unit)
        if self._relief is not None:
            self._relief.use(3)

    def release(self) -> None:
        """Release the GL objects."""
        for textures in (*self._textures.values(), self._reliefs.values()):
            for texture in textures:
                texture.release()
        self._textures, self._solved, self._flat = {}, (), ()
        self._reliefs, self._relief = {}, None

    def _relief_of(self, relief: F32) -> moderngl.Texture:
        key = relief.shape[1], relief.shape[0]
        if key not in self._reliefs:
            self._reliefs[key] = self._context.texture(key, 1, dtype="f4")
            self._reliefs[key].filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._reliefs[key].repeat_x = self._reliefs[key].repeat_y = False
        self._reliefs[key].write(relief)
        return self._reliefs[key]

    def _written(self, kind: str, layers: U8) -> tuple[moderngl.Texture, ...]:
        """Write layers to textures, one for each panel, which are created for each new size."""
        key = kind, (layers.shape[2], layers.shape[1])
        if key not in self._textures:
            self._textures[key] = tuple(self._context.texture(key[1], 4) for _ in range(self.count))
            for texture in self._textures[key]:
                texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
                texture.repeat_x = texture.repeat_y = False
        for texture, layer in zip(self._textures[key], layers, strict=True):
            texture.write(np.ascontiguousarray(layer))
        return self._textures[key]


def mount_of(settings: PanelSettings, *, screen_px: tuple[int, int], layer_px: tuple[int, int]) -> Mount:
    """Return how a monitor shows its layer. Raises InputError for its curve, ValueError for its map."""
    matrix = layer_from_screen(
        screen_width_px=screen_px[0],
        screen_height_px=screen_px[1],
        layer_width_px=layer_px[0],
        layer_height_px=layer_px[1],
        rotation_deg=settings.rotation_deg,
        mirror=settings.mirror,
        homography=settings.homography,
    )
    # A homography's sign is arbitrary, but the third coordinate must be positive at the panel's centre.
    matrix = matrix / (matrix[2] @ np.array([screen_px[0] / 2, screen_px[1] / 2, 1.0]))
    curved = bool(settings.lut or settings.gamma != 1)
    curve = lut.curve(lut=settings.lut, gamma=settings.gamma) if curved else None
    return Mount(screen_px, matrix, permutes_pixels(matrix), curve)


class Painter:
    """Draws one panel's records by shader, in one window: contexts do not share vertex arrays."""

    def __init__(self, context: moderngl.Context, mount: Mount) -> None:
        """Compile the shader for one monitor, in its window's context."""
        self.mount = mount
        mounting = ["EXACT"] * mount.is_exact + ["CURVED"] * (mount.curve is not None)
        self._curve: moderngl.Texture | None = None
        if mount.curve is not None:
            table = np.ascontiguousarray(mount.curve.T)
            self._curve = context.texture((lut.ENTRIES, 3), 1, table.tobytes(), dtype="f4")
            self._curve.filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._curve.repeat_x = self._curve.repeat_y = False  # some drivers round weights at white to more than 0
        fixed = {
            "solved": 0, "flat_picture": 1, "curve": 2, "relief": 3,
            "screen_px": tuple(map(float, mount.screen_px)),
            "layer_from_screen": tuple(mount.layer_from_screen.T.ravel()),
        }  # fmt: skip
        self._cases = {case: _compiled(context, (*mounting, *case), fixed) for case in cases_of(mount)}

    def draw(self, textures: FrameTextures, draw: PanelDraw, index: int) -> None:
        """Draw panel `index` of an uploaded frame to the bound framebuffer."""
        program, array = self._cases[case_of(draw)]
        values: dict[str, Any] = {
            "rest": draw.rest / 255,
            "size_px": tuple(map(float, draw.size_px)),
            "solved_px": tuple(map(float, draw.solved_px)),
            "extended_px": draw.extended_px,
            "solved_from_shown": tuple(draw.solved_from_shown),
            "relief_from_shown": tuple(draw.relief_from_shown),
            "push": tuple(draw.push),
            "flatness": draw.flatness,
        }
        if draw.relief is not None:
            values["relief_px"] = tuple(map(float, draw.relief.shape[::-1]))
        set_uniforms(program, values)
        textures.use(index)
        if self._curve is not None:
            self._curve.use(2)
        array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Release the GL objects."""
        for program, array in self._cases.values():
            array.release()
            program.release()
        if self._curve is not None:
            self._curve.release()


def _compiled(
    context: moderngl.Context, names: Sequence[str], fixed: Mapping[str, Any]
) -> tuple[moderngl.Program, moderngl.VertexArray]:
    """Compile the shader with all macros in `names` defined, and set the uniforms in `fixed`."""
    head = "#version 330 core\n" + "".join(f"#define {name}\n" for name in names)
    program = context.program(vertex_shader=VERTEX, fragment_shader=head + FRAGMENT)
    set_uniforms(program, fixed)
    return program, context.vertex_array(program, [])
